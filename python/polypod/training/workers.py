"""The workers of a training: processes that each simulate a share of the envs and learn together.

`torchrun` or Ray starts them and tells each of them its number in the environment (`RANK`,
`WORLD_SIZE`, `LOCAL_RANK`, `LOCAL_WORLD_SIZE`, `MASTER_ADDR`, `MASTER_PORT`). Numbers cross over
through torch.distributed: gloo between CPUs, NCCL between GPUs, and gloo where workers share a GPU.
Messages are MessagePack, which holds numbers and text alone.
"""

import contextlib
import os
import re
import socket
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import timedelta
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt
import torch
import torch.distributed as dist
from torch.distributed.rendezvous import rendezvous

from polypod import _core

_T = TypeVar("_T")
_Bytes = npt.NDArray[np.uint8]

TIMEOUT = timedelta(minutes=5)
"""Time that workers wait for one another. All come to the same calls within an iteration."""
LOST_S = 20.0
"""Time that a worker with a broken connection waits for signs of life of those on other hosts,
s."""
SLOW = 1.5
"""A worker counts as slow if it takes this many times the median of all workers."""


class LostWorkerError(_core.ConfigError):
    """A worker is gone, or a connection to one is broken."""


class Workers:
    """This process among the workers. All of them must call the same methods in the same order."""

    def __init__(self, index: int, count: int, local_index: int, local_count: int, store: Any) -> None:
        """Use `alone` or `join`."""
        self.index = index
        """Number of this worker, counted from 0. Worker 0 writes and reports."""
        self.count = count
        self.local_index = local_index
        """Number among those of this host."""
        self.local_count = local_count
        self.waited = 0.0
        """Seconds that were spent in messages."""
        self.sent = 0
        """Bytes that this worker sent to the others for the native learner."""
        self.places = [(socket.gethostname(), os.getpid())]
        """Host and process of each worker."""
        self._store = store

    @classmethod
    def alone(cls) -> "Workers":
        """A worker without others, in this process."""
        return cls(0, 1, 0, 1, None)

    @classmethod
    def join(cls, cuda: bool) -> "Workers":
        """Joins the workers that the environment tells of; one process where it tells of none.

        Args:
            cuda: whether tensors on a GPU will be summed.

        Raises:
            ConfigError: where the others cannot be reached.
        """
        if not is_among_workers():
            return cls.alone()
        local_index, local_count = int(os.environ.get("LOCAL_RANK", 0)), int(os.environ.get("LOCAL_WORLD_SIZE", 1))
        store = None
        if cuda:
            # there may be more workers than GPUs, and each may see its own alone
            torch.cuda.set_device(local_index % torch.cuda.device_count())
        if not dist.is_initialized():
            try:
                store, index, count = next(rendezvous("env://", timeout=TIMEOUT))
                backend = _backend(store, index, count, _gpu() if cuda else "")
                dist.init_process_group(backend, store=store, rank=index, world_size=count, timeout=TIMEOUT)
            except (RuntimeError, ValueError) as error:
                raise _core.ConfigError(
                    f"cannot join the other workers: {_first_line(error)}; start them as docs/cluster.md says"
                ) from error
        workers = cls(dist.get_rank(), dist.get_world_size(), local_index, local_count, store)
        workers.places = [tuple(place) for place in workers.gather_messages(list(workers.places[0]))]
        return workers

    @property
    def backend(self) -> str:
        """Backend that carries tensors of GPUs: nccl or gloo; none for one process."""
        if self.count == 1:
            return "none"
        return "nccl" if "nccl" in dist.get_backend_config() else "gloo"

    @property
    def is_first(self) -> bool:
        """Whether this worker writes and reports."""
        return self.index == 0

    def close(self) -> None:
        """Leaves the others."""
        if self.count > 1 and self._store is not None and dist.is_initialized():
            dist.destroy_process_group()

    def share(self, num_envs: int, learner: str) -> tuple[int, int] | None:
        """The envs [start, end) that this worker simulates; None: all.

        Args:
            num_envs: of all workers.
            learner: native, whose shares are whole blocks of envs, or rsl_rl, whose shares are
                equal.

        Raises:
            ConfigError: for a number of envs that cannot be shared out.
        """
        if self.count == 1:
            return None
        if learner == "native":
            return _core.share_of_worker(num_envs, self.index, self.count)
        if num_envs % self.count:
            raise _core.ConfigError(
                f"{self.count} workers cannot have equally many of {num_envs} envs, which rsl_rl asks for; "
                f"set --num-envs to a multiple of {self.count}"
            )
        own = num_envs // self.count
        return self.index * own, (self.index + 1) * own

    def gather(self, mine: _Bytes) -> _Bytes:
        """`mine` of all workers, in their order; all have one length."""
        if self.count == 1:
            return mine
        self.sent += mine.size * (self.count - 1)
        all_of_them = np.empty(self.count * mine.size, np.uint8)
        with self._talking():
            dist.all_gather_into_tensor(torch.from_numpy(all_of_them), torch.from_numpy(mine))
        return all_of_them

    def exchange(self, mine: _Bytes) -> _Bytes:
        """The pieces of all workers for this one, in their order.

        `mine` has a piece of one length for each of them.
        """
        if self.count == 1:
            return mine
        self.sent += mine.size // self.count * (self.count - 1)
        pieces = np.empty_like(mine)
        with self._talking():
            dist.all_to_all_single(torch.from_numpy(pieces), torch.from_numpy(mine))
        return pieces

    def gather_bytes(self, mine: bytes) -> list[bytes]:
        """Bytes of any length of all workers."""
        if self.count == 1:
            return [mine]
        lengths = self._lengths(len(mine))
        longest = max(lengths)
        padded = np.zeros(longest, np.uint8)
        padded[: len(mine)] = np.frombuffer(mine, np.uint8)
        rows = self.gather(padded).reshape(self.count, longest)
        return [row[:length].tobytes() for row, length in zip(rows, lengths, strict=True)]

    def bytes_for_first(self, mine: bytes) -> list[bytes]:
        """Gathers such bytes for worker 0 alone; returns an empty list to the others."""
        if self.count == 1:
            return [mine]
        lengths = self._lengths(len(mine))
        longest = max(lengths)
        padded = torch.zeros(longest, dtype=torch.uint8)
        padded[: len(mine)] = torch.frombuffer(bytearray(mine), dtype=torch.uint8)
        rows = [torch.empty_like(padded) for _ in range(self.count)] if self.is_first else None
        with self._talking():
            dist.gather(padded, rows, dst=0)
        return [row[:length].numpy().tobytes() for row, length in zip(rows or [], lengths, strict=False)]

    def _lengths(self, mine: int) -> list[int]:
        lengths: list[int] = self.gather(np.array([mine], np.int64).view(np.uint8)).view(np.int64).tolist()
        return lengths

    def gather_messages(self, mine: Any) -> list[Any]:
        """Returns the messages of all workers: numbers, text, bytes, lists and dicts of these."""
        return [msgspec.msgpack.decode(data) for data in self.gather_bytes(msgspec.msgpack.encode(mine))]

    def from_first(self, say: Callable[[], _T]) -> _T:
        """Message of worker 0.

        Raises:
            SystemExit: in the others where `say` raises, as it does in worker 0.
        """
        if self.count == 1:
            return say()
        if not self.is_first:
            is_said, message = msgspec.msgpack.decode(self._broadcast(b""))
            if not is_said:
                raise SystemExit(2)
            said: _T = message
            return said
        try:
            said = say()
        except BaseException:
            self._broadcast(msgspec.msgpack.encode([False, None]))
            raise
        self._broadcast(msgspec.msgpack.encode([True, said]))
        return said

    def _broadcast(self, data: bytes) -> bytes:
        """The bytes of worker 0."""
        length = torch.tensor([len(data)])
        with self._talking():
            dist.broadcast(length, src=0)
            buffer = torch.empty(int(length), dtype=torch.uint8)
            if self.is_first:
                buffer.copy_(torch.frombuffer(bytearray(data), dtype=torch.uint8))
            dist.broadcast(buffer, src=0)
        return buffer.numpy().tobytes()

    def sum(self, tensor: torch.Tensor) -> torch.Tensor:
        """The sum of the tensors of all workers, in place."""
        if self.count > 1:
            with self._talking():
                dist.all_reduce(tensor)
        return tensor

    def check_same(self, facts: Mapping[str, Any], remedy: str) -> None:
        """Compares what must be the same on all workers.

        Raises:
            ConfigError: in worker 0, for the first fact that differs.
            SystemExit: in the others.
        """
        if self.count == 1:
            return
        of_workers: list[dict[str, Any]] = self.gather_messages(dict(facts))
        for index, theirs in enumerate(of_workers):
            for name, value in of_workers[0].items():
                if theirs.get(name) != value:
                    if not self.is_first:
                        raise SystemExit(2)
                    raise _core.ConfigError(
                        f"worker {index} on {self.places[index][0]} has {name} {_shown(theirs.get(name))}, "
                        f"and worker 0 on {self.places[0][0]} has {_shown(value)}; {remedy}"
                    )

    @contextlib.contextmanager
    def names_the_lost(self) -> Iterator[None]:
        """Names the lost worker when rsl_rl's own messages of gradients fail."""
        try:
            yield
        except RuntimeError as error:
            is_message = isinstance(error, dist.DistError) or re.search("gloo|NCCL|[Cc]onnection", str(error))
            if self.count == 1 or not is_message:
                raise
            self._fail(error)

    @contextlib.contextmanager
    def _talking(self) -> Iterator[None]:
        """Counts the time, and names the worker that is gone when a connection breaks."""
        begin = time.perf_counter()
        try:
            yield
        except RuntimeError as error:
            self._fail(error)
        finally:
            self.waited += time.perf_counter() - begin

    def _fail(self, error: Exception) -> NoReturn:
        """Raises what a user is to read: in one of those that are left.

        The others end without a word.
        """
        if len(self.places) < self.count:
            raise LostWorkerError(f"cannot reach the other workers: {_first_line(error)}; start all of them anew")
        lost = self._lost()
        left = [index for index in range(self.count) if index not in lost]
        if lost and self.index != min(left, default=self.index):
            raise SystemExit(2)
        names = [f"worker {index} (process {self.places[index][1]} on {self.places[index][0]})" for index in lost]
        what = f"{' and '.join(names)} {'is' if len(names) == 1 else 'are'} gone" if names else "a connection is broken"
        raise LostWorkerError(
            f"{what}, and the training ends ({_first_line(error)}); go on from the last checkpoint with --resume"
        ) from error

    def _lost(self) -> list[int]:
        """The lost workers: ended processes of this host, and those without a sign of life."""
        missing = set(range(self.count)) - {self.index}
        end = time.monotonic() + LOST_S
        if self._store is None:
            return [index for index in sorted(missing) if not self._may_live(index)]
        with contextlib.suppress(RuntimeError):
            self._store.set(_sign(self.index), "here")
            while time.monotonic() < end:
                missing = {index for index in missing if not self._store.check([_sign(index)])}
                if not any(map(self._may_live, missing)):
                    break
                time.sleep(0.1)
        return sorted(missing)

    def _may_live(self, index: int) -> bool:
        """Whether it is not known that a worker has ended."""
        host, process = self.places[index]
        if host != self.places[self.index][0] or not Path("/proc/self/stat").exists():
            return True
        try:
            state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
        except OSError:
            return False
        return state != "Z"


def is_among_workers() -> bool:
    """Whether this process was started as one of several."""
    return int(os.environ.get("WORLD_SIZE", 1)) > 1


def _gpu() -> str:
    """Identifier of this process's GPU, unique over all hosts."""
    return str(torch.cuda.get_device_properties(torch.cuda.current_device()).uuid)


def _backend(store: Any, index: int, count: int, gpu: str) -> str:
    """Backend of the tensors: NCCL where each worker has a separate GPU, else gloo.

    NCCL refuses workers that share a GPU. gloo sums tensors of GPUs by way of the CPU.

    Args:
        store: key-value store of all workers.
        index: of this worker.
        count: of all workers.
        gpu: of this worker; empty: it has none.
    """
    store.set(f"polypod/gpu/{index}", gpu)
    gpus = {store.get(f"polypod/gpu/{other}") for other in range(count)}
    return "cpu:gloo,cuda:nccl" if len(gpus - {b""}) == count else "gloo"


def threads_of(workers: Workers, threads: int | None) -> int | None:
    """Threads of this worker: as asked for, or its share of the cores; None: all cores."""
    if threads is not None or workers.local_count == 1:
        return threads
    return max(1, _core.info()["threads"] // workers.local_count)


def slow_workers(times: Sequence[tuple[float, float]]) -> list[int]:
    """The workers that keep the others waiting.

    `times` are the seconds that each worked and waited.
    """
    median = sorted(worked for worked, _ in times)[(len(times) - 1) // 2]
    return [index for index, (worked, _) in enumerate(times) if worked > SLOW * median]


def flat(tables: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested tables as one, with dotted keys."""
    pairs: dict[str, Any] = {}
    for key, value in tables.items():
        pairs |= flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return pairs


def _sign(index: int) -> str:
    return f"polypod/here/{index}"


def _shown(value: Any) -> str:
    text = "none" if value is None else str(value)
    return text if len(text) <= 80 else f"{text[:80]} ..."


def _first_line(error: Exception) -> str:
    """The first line of a message of torch's, without the place in its source and its advice."""
    line = next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)
    return re.sub(r"^\[[^\]]*\.cc:\d+\] ", "", line).partition(". ")[0]
