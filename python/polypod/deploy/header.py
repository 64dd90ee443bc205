"""A contract as a C++ header: a function that returns it, for `onboard/policy_loop.hpp`.

The loop reads no JSON.
"""

import math
from collections.abc import Iterable

from polypod.deploy.onboard.policy_contract import Contract

_HEAD = """\
// The contract of {name} with {robot}. Written by `polypod deploy write`: do not edit.
#pragma once

#include "onboard/policy_loop.hpp"

namespace policy {{

// SHA-256 of the contract in the graph: compare it with the graph's metadata "polypod_contract_sha256".
inline constexpr const char* kContractSha256 = {sha256};

inline polypod::Contract contract() {{
  polypod::Contract c;
"""
_TAIL = """\
  return c;
}

}  // namespace policy
"""


def header_of(contract: Contract) -> str:
    """The text of the header."""
    safety = contract.safety
    lines = [
        f"c.is_folded = {_flag(contract.graph == 'folded')};",
        f"c.robot = {_text(contract.robot)};",
        f"c.control_dt = {_number(contract.control_dt)};",
        f"c.base_com = {_list(map(_number, contract.base_com))};",
        "c.joints = {",
        *(
            f"    {_list([_text(j.name), str(_index(j.column)), *map(_number, _numbers_of(j))])},"
            for j in contract.joints
        ),
        "};",
        f"c.joint_of_column = {_list(str(_index(joint)) for joint in contract.joint_of_column)};",
        "c.terms = {",
        *(f"    {term}," for term in _terms(contract)),
        "};",
        f"c.inputs = {_list(_list([_text(name), str(size)]) for name, size in contract.inputs.items())};",
        f"c.outputs = {_list(_list([_text(name), str(size)]) for name, size in contract.outputs.items())};",
        f"c.states = {_list(_states(contract))};",
        f"c.command_low = {_list(map(_number, contract.command_low))};",
        f"c.command_high = {_list(map(_number, contract.command_high))};",
        f"c.num_rays = {contract.num_rays};",
        f"c.stale_after = {_number(safety.stale_after)};",
        f"c.max_tilt = {_number(safety.max_tilt)};",
        f"c.joint_margin = {_number(safety.joint_margin)};",
        f"c.quaternion_tolerance = {_number(safety.quaternion_tolerance)};",
        f"c.safe_damping = {_list(map(_number, safety.damping))};",
        f"c.stand_time = {_number(safety.stand_time)};",
    ]
    if contract.motors is not None:
        joints = contract.joint_names
        places = (-1 if joint is None else joints.index(joint) for joint in contract.motors.joints)
        lines += [
            f"c.motor_joints = {_list(map(str, places))};",
            f"c.motor_modes = {_list(map(str, contract.motors.modes))};",
        ]
    comment = {key: _comment(value) for key, value in (("name", contract.name), ("robot", contract.robot))}
    body = "".join(f"  {line}\n" for line in lines)
    return _HEAD.format(**comment, sha256=_text(contract.sha256)) + body + _TAIL


def _numbers_of(joint: object) -> list[float]:
    keys = ("sign", "action_scale", "default_pos", "lower", "upper", "stiffness", "damping", "effort_limit")
    return [getattr(joint, key) for key in keys]


def _terms(contract: Contract) -> Iterable[str]:
    for term in contract.terms:
        low, high = (-math.inf, math.inf) if term.clip is None else term.clip
        yield _list(
            [
                _text(term.name),
                f"polypod::Source::{term.source}",
                str(term.size),
                str(term.history),
                _list(map(_text, term.inputs)),
                *map(_number, (term.offset, low, high, term.scale)),
                _list(map(_number, term.constant or ())),
            ]
        )


def _states(contract: Contract) -> Iterable[str]:
    for name, (output, shape) in contract.states.items():
        yield _list([_text(name), _text(output), _list(map(str, shape))])


def _index(value: int | None) -> int:
    return -1 if value is None else value


def _flag(value: bool) -> str:
    return "true" if value else "false"


def _number(value: float) -> str:
    if math.isinf(value):
        return "polypod::kNone" if value > 0 else "-polypod::kNone"
    return repr(float(value))


def _list(values: Iterable[str]) -> str:
    return "{" + ", ".join(values) + "}"


def _text(value: str) -> str:
    """A literal: bytes of UTF-8, others than plain ones as octal escapes of three digits."""
    plain = (chr(byte) if 32 <= byte < 127 and chr(byte) not in '"\\?' else f"\\{byte:03o}" for byte in value.encode())
    return '"' + "".join(plain) + '"'


def _comment(value: str) -> str:
    """A name within a line of comment."""
    return "".join(letter if letter.isascii() and letter.isprintable() and letter != "\\" else "_" for letter in value)
