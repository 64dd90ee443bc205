"""TensorBoard's curves, written by the training's own thread, in whole records."""

import io
import itertools
import os
import socket
import time
from collections.abc import Callable
from pathlib import Path

from tensorboard.compat.proto import event_pb2, summary_pb2
from tensorboard.summary.writer.record_writer import RecordWriter

MAX_PENDING = 16 << 20
"""Bytes that wait for a disk that takes nothing: some 10,000 iterations. Beyond them the oldest are
given up."""
_files = itertools.count()


class Curves:
    """One file of TensorBoard's events.

    TensorBoard's writer has a thread that ends with a traceback where the disk is full, and the
    training with it. Here records wait for the next flush, and half a record is taken back: readers
    stop at one.
    """

    def __init__(self, folder: Path, purge_step: int | None, warn: Callable[[str], None]) -> None:
        """Begins a file in `folder`.

        Records of `purge_step` and later in older files are dropped by readers.

        `warn` is told when the disk takes nothing, once until it does again.
        """
        name = f"events.out.tfevents.{int(time.time()):010d}.{socket.gethostname()}.{os.getpid()}.{next(_files)}"
        self.path = folder / name
        self._warn = warn
        self._file: io.FileIO | None = None
        self._pending: list[bytes] = []
        self._waits = False
        step = purge_step or 0
        self._add(event_pb2.Event(wall_time=time.time(), step=step, file_version="brain.Event:2"))
        if purge_step is not None:
            start = event_pb2.SessionLog(status=event_pb2.SessionLog.START)
            self._add(event_pb2.Event(wall_time=time.time(), step=step, session_log=start))
        self._head = len(self._pending)
        self.flush()

    def add_scalar(self, tag: str, scalar_value: float, global_step: int) -> None:
        """Records one number."""
        summary = summary_pb2.Summary(value=[summary_pb2.Summary.Value(tag=tag, simple_value=scalar_value)])
        self._add(event_pb2.Event(wall_time=time.time(), step=global_step, summary=summary))

    def flush(self) -> None:
        """Writes what is recorded, or keeps it for the next time."""
        data = b"".join(self._pending)
        try:
            self._append(data)
        except OSError as error:
            if not self._waits:
                self._warn(f"cannot write {self.path}: {error.strerror}; the curves wait for the disk")
            self._waits = True
            while sum(map(len, self._pending)) > MAX_PENDING:
                del self._pending[self._head]
            return
        self._pending.clear()
        self._head, self._waits = 0, False

    def close(self) -> None:
        """Writes what is recorded, if that can be, and ends the file."""
        self.flush()
        if self._file is not None:
            self._file.close()

    def _add(self, event: event_pb2.Event) -> None:
        record = io.BytesIO()
        RecordWriter(record).write(event.SerializeToString())
        self._pending.append(record.getvalue())

    def _append(self, data: bytes) -> None:
        if self._file is None:
            self._file = io.FileIO(self.path, "xb")
        begin = self._file.tell()
        try:
            view = memoryview(data)
            while view:
                view = view[self._file.write(view) :]
        except OSError:
            self._file.truncate(begin)
            self._file.seek(begin)
            raise
