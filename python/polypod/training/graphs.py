"""CUDA graphs of what a learner computes again and again with the same shapes."""

from collections.abc import Callable, Hashable

import torch

WARM_UP = 3
"""Runs before a capture, as torch's documentation of CUDA graphs asks for."""


class Graphs:
    """Steps that a CUDA device replays as graphs.

    On another device they are computed as they are.
    """

    def __init__(self, device: torch.device, changed: Callable[[], list[torch.Tensor]], is_alone: bool) -> None:
        """Prepares the steps; nothing is captured before the first one.

        Args:
            device: where the steps compute.
            changed: the tensors that steps change and begin with. A capture leaves them as they
                were.
            is_alone: no other worker learns along, whose NCCL goes on during a capture in a thread.
        """
        self._device, self._changed = device, changed
        self._mode = "global" if is_alone else "thread_local"
        self._graphs: dict[Hashable, torch.cuda.CUDAGraph] = {}

    def run(self, key: Hashable, step: Callable[[], None]) -> None:
        """Computes a step.

        Each key has one graph, which reads and writes the tensors of its first run.
        """
        if self._device.type != "cuda":
            step()
            return
        if key not in self._graphs:
            self._graphs[key] = self._capture(step)
        self._graphs[key].replay()

    def _capture(self, step: Callable[[], None]) -> torch.cuda.CUDAGraph:
        tensors, random = self._changed(), torch.cuda.get_rng_state(self._device)
        before = [tensor.clone() for tensor in tensors]
        stream = torch.cuda.Stream(self._device)  # type: ignore[no-untyped-call]
        stream.wait_stream(torch.cuda.current_stream(self._device))
        with torch.cuda.stream(stream):
            for _ in range(WARM_UP):
                step()
        torch.cuda.current_stream(self._device).wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        # on the stream of the steps before, whose autograd nodes live on
        with torch.cuda.graph(graph, stream=stream, capture_error_mode=self._mode):
            step()
        for tensor, values in zip(tensors, before, strict=True):
            tensor.copy_(values)
        torch.cuda.set_rng_state(random, self._device)
        return graph
