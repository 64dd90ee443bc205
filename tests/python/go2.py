"""A Go2 of one's own, for tests of what a URDF or a config may say."""

import re

from common import ROOT

URDF = ROOT / "assets/robots/unitree_go2/robot.urdf"
_TOML = ROOT / "configs/robots/unitree_go2.toml"


def write_go2(root, edit=lambda urdf: urdf, lines="", toml=None):
    """Writes the robot `mine` into a root of configs.

    Args:
        root: what `POLYPOD_PATH` names.
        edit: makes its URDF of the Go2's.
        lines: TOML on top of the Go2's.
        toml: all of its TOML.
    """
    folder = root / "configs/robots"
    folder.mkdir(parents=True, exist_ok=True)
    (root / "mine.urdf").write_text(edit(URDF.read_text()))
    head = 'extends = "unitree_go2"\nname = "mine"\ntitle = "Mine"\nurdf = "../../mine.urdf"\n'
    (folder / "mine.toml").write_text(head + lines if toml is None else toml)


def limits(joint, change):
    """Returns an edit of the attributes of a joint's <limit>."""

    def edit(urdf):
        start = urdf.index("<limit", urdf.index(f'name="{joint}"'))
        end = urdf.index("/>", start)
        return urdf[:start] + change(urdf[start:end]) + urdf[end:]

    return edit


def without_actuator_limits():
    """Returns a TOML of `mine` that leaves effort and speed to the URDF."""
    text = _TOML.read_text().replace('name = "unitree_go2"', 'name = "mine"').replace('"dc_motor"', '"ideal_pd"')
    text = re.sub(r"(?m)^(effort_limit|saturation_effort|velocity_limit) .*\n", "", text)
    return re.sub(r"(?m)^urdf = .*$", 'urdf = "../../mine.urdf"', text)
