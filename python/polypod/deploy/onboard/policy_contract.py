"""The contract of a policy on a robot, read from its file and compared with the rest of it.

It needs no other package. `docs/deploy.md` of polypod explains the contract, `contract.schema.json`
is its schema.
"""

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

VERSION = 1
KEY, SUM_KEY = "polypod_contract", "polypod_contract_sha256"
MAX_TEXT = 4 << 20
"""Largest contract, bytes."""
MAX_FILE = 1 << 30
"""Largest graph, bytes."""
MAX_JOINTS = 1024
MAX_NUMBERS = 1 << 20
"""Most numbers of an observation, an input or a state."""
MAX_NAME = 4096

SOURCES = {
    "measured": 1,
    "robot_constant": 0,
    "center_of_mass_velocity": 2,
    "base_angular_velocity": 1,
    "projected_gravity": 1,
    "velocity_command": 1,
    "joint_position": 1,
    "joint_position_minus_default": 1,
    "joint_velocity": 1,
    "last_action": 1,
    "height_scan": 1,
}
"""Formulas of terms, and the number of inputs of each."""
OF_JOINTS = ("joint_position", "joint_position_minus_default", "joint_velocity")


class ContractError(ValueError):
    """A file that no loop obeys: the message names file, element, problem and remedy."""


@dataclasses.dataclass(frozen=True)
class Joint:
    """A joint of the robot; infinity where a limit is absent."""

    name: str
    slot: str | None
    column: int | None
    """Column of the action; None for a joint that the policy does not move."""
    sign: float
    action_scale: float
    """rad per unit of action, with the joint's sign."""
    default_pos: float
    lower: float
    upper: float
    stiffness: float
    damping: float
    armature: float
    effort_limit: float
    velocity_limit: float
    delay: tuple[float, float]
    drive: str


@dataclasses.dataclass(frozen=True)
class Term:
    """A term of the observation."""

    name: str
    start: int
    size: int
    history: int
    source: str
    inputs: tuple[str, ...]
    offset: float
    clip: tuple[float, float] | None
    scale: float
    constant: tuple[float, ...] | None

    @property
    def width(self) -> int:
        """Numbers of one control step."""
        return self.size // self.history


@dataclasses.dataclass(frozen=True)
class Safety:
    """When a loop gives up, and how."""

    stale_after: float
    max_tilt: float
    joint_margin: float
    quaternion_tolerance: float
    damping: tuple[float, ...]
    stand_time: float


@dataclasses.dataclass(frozen=True)
class Motors:
    """Motors of a maker's interface, in its order."""

    interface: str
    joints: tuple[str | None, ...]
    modes: tuple[int, ...]


@dataclasses.dataclass(frozen=True)
class Contract:
    """Contract of a file: its promises and demands."""

    graph: str
    """"folded": sensors to joint targets; "network": the observation to the action."""
    name: str
    robot: str
    control_dt: float
    base_com: tuple[float, float, float]
    joints: tuple[Joint, ...]
    columns: tuple[str, ...]
    joint_of_column: tuple[int | None, ...]
    terms: tuple[Term, ...]
    inputs: dict[str, int]
    outputs: dict[str, int]
    states: dict[str, tuple[str, tuple[int, ...]]]
    """Memories by input: the output that is fed back, and the shape of one robot's memory."""
    command_low: tuple[float, ...]
    command_high: tuple[float, ...]
    num_rays: int
    estimated: tuple[str, ...]
    mapped: tuple[str, ...]
    safety: Safety
    motors: Motors | None
    sha256: str
    """SHA-256 of the text."""

    @property
    def joint_names(self) -> list[str]:
        """Names of the joints, in order."""
        return [joint.name for joint in self.joints]

    @property
    def sensed(self) -> list[str]:
        """Inputs of the terms of the observation, in order."""
        return list(dict.fromkeys(name for term in self.terms for name in term.inputs))


def read_contract(text: str | None, name: str, said: Mapping[str, str] | None = None) -> Contract:
    """A contract from its text, compared with the other metadata of its file. Raises ContractError.

    Args:
        text: JSON; None where the file holds none.
        name: of the file, in errors.
        said: all metadata of the file; None for a contract alone.
    """
    read = _Reader(name)
    if text is None:
        read.fail(f"metadata {KEY}", "is missing", "export the policy for one robot: polypod export --robots NAME")
    contract = read.contract(text or "")
    if said is not None:
        read.compare(contract, said)
    return contract


def check_tensors(contract: Contract, inputs: Sequence[Any], outputs: Sequence[Any], name: str) -> None:
    """Compares a contract with the tensors of its graph, each with `name`, `type` and `shape`.

    Raises ContractError.
    """
    read = _Reader(name)
    wanted: dict[str, tuple[int, ...]] = {key: (1, size) for key, size in contract.inputs.items()}
    wanted |= {key: shape for key, (_, shape) in contract.states.items()}
    given: dict[str, tuple[int, ...]] = {key: (1, size) for key, size in contract.outputs.items()}
    given |= dict(contract.states.values())
    for kind, promised, found in (("input", wanted, inputs), ("output", given, outputs)):
        there = {entry.name: entry for entry in found}
        for key in promised.keys() ^ there.keys():
            where = "the contract" if key in promised else "the graph"
            read.fail(f"{kind} {key[:80]}", f"is in {where} alone", _AGAIN)
        for key, shape in promised.items():
            sizes = [size if isinstance(size, int) else 1 for size in there[key].shape]
            if there[key].type != "tensor(float)" or tuple(sizes) != shape:
                problem = f"is {there[key].type} of shape {there[key].shape}, but the contract says float {list(shape)}"
                read.fail(f"{kind} {key[:80]}", problem, _AGAIN)


_AGAIN = "export the policy again"


class _Reader:
    """Reads a contract, element by element."""

    def __init__(self, name: str) -> None:
        self.name = name

    def fail(self, element: str, problem: str, remedy: str = _AGAIN) -> Any:
        raise ContractError(f"{self.name}: {element} {problem}; {remedy}")

    def contract(self, text: str) -> Contract:
        if len(text) > MAX_TEXT:
            self.fail("contract", f"has more than {MAX_TEXT >> 20} MiB")
        try:
            root = json.loads(text, parse_constant=_no_constant, object_pairs_hook=_once)
        except (ValueError, RecursionError) as error:
            self.fail("contract", f"is no JSON: {str(error)[:200] or type(error).__name__}")
        root = self.table(root, "contract")
        if root.get("version") != VERSION or isinstance(root.get("version"), bool):
            problem = f"is {str(root.get('version'))[:40]}, but this loop reads version {VERSION}"
            self.fail("contract.version", problem, "export the policy again, or use the loop of its polypod")
        graph = self.one_of(root, "graph", "contract", ("folded", "network"))
        joints = tuple(
            self.joint(entry, f"contract.joints[{at}]")
            for at, entry in enumerate(self.rows(root, "joints", MAX_JOINTS))
        )
        names = [joint.name for joint in joints]
        if len(set(names)) != len(names):
            self.fail("contract.joints", "names a joint twice")
        columns, of_column = self.columns(root, joints)
        observation = self.table(self.get(root, "observation", "contract"), "contract.observation")
        self.one_of(observation, "order", "contract.observation", ("oldest_first",))
        self.one_of(observation, "normalization", "contract.observation", ("in_graph", "none"))
        terms = self.terms(observation, len(joints), len(columns))
        safety = self.safety(self.table(self.get(root, "safety", "contract"), "contract.safety"), len(joints))
        command = self.table(self.get(root, "command", "contract"), "contract.command")
        low, high = (self.numbers(command, key, "contract.command", 3) for key in ("low", "high"))
        if any(a > b for a, b in zip(low, high, strict=True)):
            self.fail("contract.command.low", "is above contract.command.high")
        rates = self.table(self.get(root, "rates", "contract"), "contract.rates")
        robot = self.table(self.get(root, "robot", "contract"), "contract.robot")
        policy = self.table(self.get(root, "policy", "contract"), "contract.policy")
        needs = self.table(self.get(root, "needs", "contract"), "contract.needs")
        scan = self.get(root, "height_scan", "contract")
        points = [] if scan is None else self.list(self.table(scan, "contract.height_scan"), "points", MAX_NUMBERS)
        x, y, z = self.numbers(robot, "base_com", "contract.robot", 3)
        contract = Contract(
            graph=graph,
            name=self.text(policy, "name", "contract.policy"),
            robot=self.text(robot, "name", "contract.robot"),
            control_dt=self.number(rates, "control_dt", "contract.rates", 1e-4, 10.0),
            base_com=(x, y, z),
            joints=joints,
            columns=columns,
            joint_of_column=of_column,
            terms=terms,
            inputs=self.tensors(root, "inputs"),
            outputs=self.tensors(root, "outputs"),
            states=self.states(root),
            command_low=low,
            command_high=high,
            num_rays=len(points),
            estimated=self.texts(needs, "estimated", "contract.needs"),
            mapped=self.texts(needs, "mapped", "contract.needs"),
            safety=safety,
            motors=self.motors(self.get(root, "motors", "contract"), names),
            sha256=hashlib.sha256(text.encode()).hexdigest(),
        )
        self.check(contract, self.whole(observation, "size", "contract.observation", 1, MAX_NUMBERS))
        return contract

    def joint(self, entry: Any, where: str) -> Joint:
        row = self.table(entry, where)
        lower = self.limit(row, "lower", where, -math.inf)
        upper = self.limit(row, "upper", where, math.inf)
        if lower > upper:
            self.fail(f"{where}.lower", f"is {lower:g}, above {where}.upper, {upper:g}")
        column = self.get(row, "column", where)
        if column is not None:
            column = self.whole(row, "column", where, 0, MAX_JOINTS * 64)
        slot = self.get(row, "slot", where)
        sign = self.number(row, "sign", where, -1.0, 1.0)
        scale = self.number(row, "action_scale", where)
        if (column is None) != (slot is None) or (abs(sign) != 1.0 if column is not None else sign != 0.0):
            self.fail(f"{where}.column", "contradicts its slot and its sign")
        if scale * sign < 0.0 or (column is None and scale != 0.0):
            self.fail(f"{where}.action_scale", f"is {scale:g}, but the joint has the sign {sign:g}")
        delay = self.numbers(row, "delay", where, 2)
        if not 0.0 <= delay[0] <= delay[1]:
            self.fail(f"{where}.delay", f"is {list(delay)}; it is the least and the largest delay, s")
        return Joint(
            name=self.text(row, "name", where),
            slot=None if slot is None else self.text(row, "slot", where),
            column=column,
            sign=sign,
            action_scale=scale,
            default_pos=self.number(row, "default_pos", where),
            lower=lower,
            upper=upper,
            stiffness=self.number(row, "stiffness", where, 0.0),
            damping=self.number(row, "damping", where, 0.0),
            armature=self.number(row, "armature", where, 0.0),
            effort_limit=self.limit(row, "effort_limit", where, math.inf, 0.0),
            velocity_limit=self.limit(row, "velocity_limit", where, math.inf, 0.0),
            delay=(delay[0], delay[1]),
            drive=self.one_of(row, "drive", where, ("gains", "network")),
        )

    def columns(self, root: Any, joints: Sequence[Joint]) -> tuple[tuple[str, ...], tuple[int | None, ...]]:
        names, of_column = [], []
        for at, entry in enumerate(self.rows(root, "columns", MAX_JOINTS * 64)):
            where = f"contract.columns[{at}]"
            row = self.table(entry, where)
            names.append(self.text(row, "name", where))
            joint = self.get(row, "joint", where)
            if joint is not None:
                joint = self.whole(row, "joint", where, 0, len(joints) - 1)
                if joints[joint].column != at:
                    self.fail(
                        f"{where}.joint", f"is {joint}, but contract.joints[{joint}].column is {joints[joint].column}"
                    )
            of_column.append(joint)
        for index, joint in enumerate(joints):
            if joint.column is not None and (joint.column >= len(names) or of_column[joint.column] != index):
                self.fail(f"contract.joints[{index}].column", f"is {joint.column}, which contract.columns contradicts")
        return tuple(names), tuple(of_column)

    def terms(self, observation: Any, joints: int, columns: int) -> tuple[Term, ...]:
        terms: list[Term] = []
        for at, entry in enumerate(self.rows(observation, "terms", MAX_JOINTS, "contract.observation")):
            where = f"contract.observation.terms[{at}]"
            row = self.table(entry, where)
            clip = self.get(row, "clip", where)
            limits = None if clip is None else self.numbers(row, "clip", where, 2)
            if limits is not None and limits[0] > limits[1]:
                self.fail(f"{where}.clip", f"is {list(limits)}; it is the lower and the upper limit")
            size = self.whole(row, "size", where, 1, MAX_NUMBERS)
            constant = self.get(row, "constant", where)
            source = self.one_of(row, "source", where, tuple(SOURCES))
            term = Term(
                name=self.text(row, "name", where),
                start=self.whole(row, "start", where, 0, MAX_NUMBERS),
                size=size,
                history=self.whole(row, "history", where, 1, size),
                source=source,
                inputs=self.texts(row, "inputs", where),
                offset=self.number(row, "offset", where),
                clip=None if limits is None else (limits[0], limits[1]),
                scale=self.number(row, "scale", where),
                constant=None if constant is None else self.numbers(row, "constant", where, size),
            )
            if term.start != sum(other.size for other in terms):
                self.fail(
                    f"{where}.start", f"is {term.start}, but the terms before it have {sum(t.size for t in terms)}"
                )
            if term.size % term.history:
                self.fail(f"{where}.history", f"is {term.history}, which does not divide its size, {term.size}")
            if len(term.inputs) != SOURCES[source] or (term.constant is None) != (source != "robot_constant"):
                self.fail(f"{where}.source", f"is {source}, which its inputs or its constant contradict")
            wanted = columns if source in OF_JOINTS or source == "last_action" else None
            wanted = 3 if source in _VECTORS else wanted
            if wanted is not None and term.width != wanted:
                self.fail(f"{where}.size", f"gives {term.width} numbers a step, but {source} has {wanted}")
            terms.append(term)
        return tuple(terms)

    def safety(self, row: Any, joints: int) -> Safety:
        where = "contract.safety"
        self.one_of(row, "behaviour", where, ("damping",))
        damping = self.numbers(row, "damping", where, joints)
        if min(damping, default=0.0) < 0.0:
            self.fail(f"{where}.damping", "holds a number below 0")
        return Safety(
            stale_after=self.number(row, "stale_after", where, 1e-4, 10.0),
            max_tilt=self.number(row, "max_tilt", where, 0.01, math.pi),
            joint_margin=self.number(row, "joint_margin", where, 0.0, 10.0),
            quaternion_tolerance=self.number(row, "quaternion_tolerance", where, 0.0, 0.5),
            damping=damping,
            stand_time=self.number(row, "stand_time", where, 0.01, 600.0),
        )

    def motors(self, value: Any, names: Sequence[str]) -> Motors | None:
        if value is None:
            return None
        where = "contract.motors"
        row = self.table(value, where)
        joints = self.list(row, "joints", MAX_JOINTS, where)
        for joint in joints:
            if joint is not None and joint not in names:
                self.fail(f"{where}.joints", f"names {str(joint)[:80]}, which is no joint of the contract")
        if absent := set(names) - set(joints):
            self.fail(f"{where}.joints", f"lacks {min(absent)[:80]}, a joint of the contract")
        if len(set(names)) != sum(joint is not None for joint in joints):
            self.fail(f"{where}.joints", "names a joint twice")
        modes = self.list(row, "modes", MAX_JOINTS, where)
        if len(modes) != len(joints) or not all(type(mode) is int and 0 <= mode <= 255 for mode in modes):
            self.fail(f"{where}.modes", "is no list of a number from 0 to 255 for each motor")
        return Motors(self.text(row, "interface", where), tuple(joints), tuple(modes))

    def tensors(self, root: Any, key: str) -> dict[str, int]:
        sizes: dict[str, int] = {}
        for at, entry in enumerate(self.rows(root, key, MAX_JOINTS)):
            where = f"contract.{key}[{at}]"
            row = self.table(entry, where)
            name = self.text(row, "name", where)
            if name in sizes:
                self.fail(f"{where}.name", f"is {name[:80]}, which is there already")
            sizes[name] = self.whole(row, "size", where, 1, MAX_NUMBERS)
        return sizes

    def states(self, root: Any) -> dict[str, tuple[str, tuple[int, ...]]]:
        states: dict[str, tuple[str, tuple[int, ...]]] = {}
        for at, entry in enumerate(self.list(root, "states", 16)):
            where = f"contract.states[{at}]"
            row = self.table(entry, where)
            shape = self.list(row, "shape", 3, where)
            if len(shape) not in (2, 3) or not all(type(n) is int and 1 <= n <= MAX_NUMBERS for n in shape):
                self.fail(f"{where}.shape", f"is {str(shape)[:80]}; it has two or three sizes")
            if math.prod(shape) > MAX_NUMBERS:
                self.fail(f"{where}.shape", f"is {shape}, more than {MAX_NUMBERS} numbers")
            states[self.text(row, "input", where)] = (self.text(row, "output", where), tuple(shape))
        return states

    def check(self, contract: Contract, size: int) -> None:
        """Compares the parts of a contract."""
        if contract.terms and size != sum(term.size for term in contract.terms):
            problem = f"is {size}, but its terms have {sum(term.size for term in contract.terms)}"
            self.fail("contract.observation.size", problem)
        joints, columns = len(contract.joints), len(contract.columns)
        sizes = {"joint_pos": joints, "joint_vel": joints, "last_action": columns, "height_scan": contract.num_rays}
        sizes |= dict.fromkeys(("base_lin_vel", "base_ang_vel", "projected_gravity", "velocity_commands"), 3)
        wanted = dict.fromkeys(contract.sensed, 0) if contract.graph == "folded" else {"obs": size}
        outputs = {"actions": columns} | ({"joint_pos_target": joints} if contract.graph == "folded" else {})
        for key, given, promised in (("inputs", contract.inputs, wanted), ("outputs", contract.outputs, outputs)):
            for name in given.keys() - promised.keys():
                self.fail(f"contract.{key}", f"holds {name[:80]}, which no {contract.graph} graph of these terms has")
            for name in promised.keys() - given.keys():
                self.fail(f"contract.{key}", f"lacks {name[:80]}, which a {contract.graph} graph of these terms has")
            for name, found in given.items():
                expected = sizes.get(name, promised[name] or found)
                if found != expected:
                    self.fail(f"contract.{key}", f"gives {name[:80]} {found} numbers, but the robot has {expected}")

    def compare(self, contract: Contract, said: Mapping[str, str]) -> None:
        """Compares the contract with mjlab's keys and those of polypod."""
        if SUM_KEY in said and said[SUM_KEY] != contract.sha256:
            self.fail(f"metadata {SUM_KEY}", "is not that of the contract: one of them was changed")
        joints = contract.joints

        def column(key: str) -> list[Any]:
            return [getattr(joint, key) for joint in joints]

        texts = {"robot": [contract.robot], "joint_names": column("name"), "action_names": list(contract.columns)}
        numbers: dict[str, list[float]] = {
            "step_dt": [contract.control_dt],
            "joint_stiffness": column("stiffness"),
            "joint_damping": column("damping"),
            "default_joint_pos": column("default_pos"),
            "joint_effort_limit": column("effort_limit"),
            "joint_pos_lower": column("lower"),
            "joint_pos_upper": column("upper"),
            "joint_signs": column("sign"),
            "action_scale": column("action_scale"),
            "base_com": list(contract.base_com),
            "observation_sizes": [term.size for term in contract.terms],
            "observation_scales": [term.scale for term in contract.terms],
            "observation_offsets": [term.offset for term in contract.terms],
            "observation_history_lengths": [term.history for term in contract.terms],
        }
        texts["observation_names"] = [term.name for term in contract.terms]
        texts["observation_sources"] = [term.source for term in contract.terms]
        texts |= {"state_inputs": list(contract.states)} if contract.states else {}
        for key in [*texts, *numbers]:
            if key not in said:
                self.fail(f"metadata {key}", "is missing")
            if len(said[key]) > MAX_TEXT:
                self.fail(f"metadata {key}", f"has more than {MAX_TEXT >> 20} MiB")
        for key, words in texts.items():
            if said[key].split(",") != words:
                self.fail(f"metadata {key}", f"is {said[key][:80]!r}, which the contract contradicts")
        for key, values in numbers.items():
            try:
                found = [float(word) for word in said[key].split(",")]
            except ValueError:
                self.fail(f"metadata {key}", f"is {said[key][:80]!r}, no list of numbers")
            if len(found) != len(values):
                self.fail(f"metadata {key}", f"has {len(found)} numbers, but the contract has {len(values)}")
            for at, (a, b) in enumerate(zip(found, values, strict=True)):
                if not (a == b or abs(a - b) <= 1e-6 * max(abs(a), abs(b), 1e-6)):
                    self.fail(f"metadata {key}[{at}]", f"is {a:g}, but the contract says {b:g}")

    def get(self, row: Mapping[str, Any], key: str, where: str) -> Any:
        if key not in row:
            self.fail(f"{where}.{key}", "is missing")
        return row[key]

    def table(self, value: Any, where: str) -> Any:
        return value if isinstance(value, dict) else self.fail(where, f"is {_kind(value)}; it must be a table")

    def list(self, row: Any, key: str, most: int, where: str = "contract") -> Any:
        value = self.get(row, key, where)
        if not isinstance(value, list):
            self.fail(f"{where}.{key}", f"is {_kind(value)}; it must be a list")
        if len(value) > most:
            self.fail(f"{where}.{key}", f"has {len(value)} entries, more than {most}")
        return value

    def rows(self, row: Any, key: str, most: int, where: str = "contract") -> Any:
        value = self.list(row, key, most, where)
        return value or self.fail(f"{where}.{key}", "is empty")

    def text(self, row: Any, key: str, where: str) -> str:
        value = self.get(row, key, where)
        if not isinstance(value, str) or not 1 <= len(value) <= MAX_NAME:
            self.fail(f"{where}.{key}", f"is {_kind(value)}; it must be a text of 1 to {MAX_NAME} characters")
        return str(value)

    def texts(self, row: Any, key: str, where: str) -> tuple[str, ...]:
        value = self.list(row, key, MAX_JOINTS, where)
        if not all(isinstance(entry, str) and 1 <= len(entry) <= MAX_NAME for entry in value):
            self.fail(f"{where}.{key}", "must be a list of texts")
        return tuple(value)

    def one_of(self, row: Any, key: str, where: str, known: tuple[str, ...]) -> str:
        value = self.get(row, key, where)
        if not isinstance(value, str) or value not in known:
            self.fail(f"{where}.{key}", f"is {str(value)[:80]!r}; it must be one of {', '.join(known)}")
        return str(value)

    def number(self, row: Any, key: str, where: str, low: float = -1e9, high: float = 1e9) -> float:
        return self.real(self.get(row, key, where), f"{where}.{key}", low, high)

    def real(self, value: Any, element: str, low: float = -1e9, high: float = 1e9) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
            shown = f"{value:.6g}" if isinstance(value, float) else _kind(value)
            self.fail(element, f"is {shown}; it must be a number from {low:g} to {high:g}")
        return float(value)

    def numbers(self, row: Any, key: str, where: str, size: int) -> tuple[float, ...]:
        value = self.list(row, key, MAX_NUMBERS, where)
        if len(value) != size:
            self.fail(f"{where}.{key}", f"has {len(value)} numbers, not {size}")
        return tuple(self.real(entry, f"{where}.{key}[{at}]") for at, entry in enumerate(value))

    def whole(self, row: Any, key: str, where: str, low: int, high: int) -> int:
        value = self.get(row, key, where)
        if type(value) is not int or not low <= value <= high:
            self.fail(f"{where}.{key}", f"is {str(value)[:40]}; it must be a whole number from {low} to {high}")
        return int(value)

    def limit(self, row: Any, key: str, where: str, absent: float, low: float = -1e9) -> float:
        return absent if self.get(row, key, where) is None else self.number(row, key, where, low)


_VECTORS = ("center_of_mass_velocity", "base_angular_velocity", "projected_gravity", "velocity_command")


def _kind(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return json.dumps(value)
    kinds = {dict: "a table", list: "a list", str: "a text", int: "a number", float: "a number"}
    return kinds.get(type(value), "of another kind")


def _no_constant(text: str) -> float:
    raise ValueError(f"{text} is no number of JSON")


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    row = dict(pairs)
    if len(row) != len(pairs):
        raise ValueError("a key stands twice in one table")
    return row
