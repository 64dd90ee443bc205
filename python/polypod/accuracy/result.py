"""Result of a comparison of one robot."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class Result:
    """Figures of one robot; subclasses say which."""

    robot: str

    @property
    def case(self) -> str:
        """Name of what was compared, in tables and messages."""
        return self.robot
