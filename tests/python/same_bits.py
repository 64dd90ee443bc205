"""Whether two trainings are the same, bit for bit."""

import torch

from polypod.runs import run_dir


def differences(one, other, place=""):
    """Where two checkpoints differ."""
    if isinstance(one, torch.Tensor):
        return [] if torch.equal(one, other) else [place]
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        return [found for key in one for found in differences(one[key], other[key], f"{place}/{key}")]
    if isinstance(one, list):
        assert len(one) == len(other)
        return [
            found for n, pair in enumerate(zip(one, other, strict=True)) for found in differences(*pair, f"{place}/{n}")
        ]
    return [] if one == other else [place]


def equal(one, other):
    """Whether two checkpoints hold the same bits.

    The seconds that the training took are not among them.
    """
    return set(differences(*(run_dir.load_checkpoint(path) for path in (one, other)))) <= {"/infos/logger/time"}
