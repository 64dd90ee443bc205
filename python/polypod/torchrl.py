"""polypod for TorchRL: envs for its collectors, whose workers share the rows of one batch.

>>> import polypod.torchrl
>>> from torchrl.collectors import MultiSyncCollector
>>> creators = polypod.torchrl.creators("velocity_flat", num_envs=4096, workers=2, seed=1)
>>> collector = MultiSyncCollector(creators, policy, frames_per_batch=24 * 4096, total_frames=-1)
"""

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING

import polypod
from polypod import _core
from polypod.extras import missing
from polypod.vector_env import fresh_seed

try:
    from torchrl.envs import GymWrapper
except ModuleNotFoundError as error:
    raise missing(error, "polypod.torchrl", "learners") from error

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from polypod.vector_env import EnvOptions


def make(task_id: str, num_envs: int | None = None, **options: "Unpack[EnvOptions]") -> GymWrapper:
    """Builds a batch of envs for TorchRL: tensors of a batch size [num_envs].

    Arguments and errors are those of `polypod.make`. Arrays must be copies, which is the default:
    TorchRL keeps them.
    """
    if not options.get("copy", True):
        raise _core.ConfigError("TorchRL keeps what it is handed: leave copy=False out")
    return GymWrapper(polypod.make(task_id, num_envs, **options))


def creators(
    task_id: str, num_envs: int, workers: int, **options: "Unpack[EnvOptions]"
) -> list[Callable[[], GymWrapper]]:
    """Makes the envs of a collector's workers: shares of one batch, with the rows of `make`.

    Args:
        task_id: as of `polypod.make`.
        num_envs: of all workers.
        workers: number of processes.
        **options: as of `polypod.make`. Without a seed one is drawn for all workers; without
            threads each worker has its share of this machine's cores.

    Raises:
        ConfigError: for a number of envs that the workers cannot share equally, and for a share of
            one worker.
    """
    if workers < 1 or num_envs % workers:
        raise _core.ConfigError(
            f"{workers} workers cannot have equally many of {num_envs} envs; choose a multiple of the workers"
        )
    if options.get("share") is not None:
        raise _core.ConfigError("share is what each worker gets; leave it out")
    own = num_envs // workers
    if options.get("seed") is None:
        options["seed"] = fresh_seed()
    if options.get("threads") is None:
        options["threads"] = max(1, _core.info()["threads"] // workers)
    shares = [(first, first + own) for first in range(0, num_envs, own)]
    of_workers: list[EnvOptions] = [{**options, "share": share} for share in shares]
    return [functools.partial(make, task_id, num_envs, **options) for options in of_workers]


__all__ = ["creators", "make"]
