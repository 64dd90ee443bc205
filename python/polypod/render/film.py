"""Films of a run: GIF and WebP by Pillow, MP4 by PyAV."""

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from polypod import _core
from polypod.extras import package
from polypod.files import write_filled

if TYPE_CHECKING:
    from PIL.Image import Image

KINDS = (".gif", ".webp", ".mp4")
MAX_SIDE = 4096
"""Largest side of a frame, pixels."""
COLORS = 64
"""Number of colours of a GIF."""
INTERVAL = 10.0
"""Time between two lines of progress, s, where standard error is no terminal."""


class Film:
    """Frames on their way into a file."""

    def __init__(self, path: Path, fps: int, size: tuple[int, int], seconds: float | None = None) -> None:
        """Nothing is written before `close`. Progress is told on standard error.

        Args:
            path: ends in `.gif`, `.webp` or `.mp4`.
            fps: frames per second, from 1 to 50.
            size: width and height, pixels; even numbers up to `MAX_SIDE`.
            seconds: length of the film, for the progress; None: not known.

        Raises:
            ConfigError: for another kind of file, rate or size, and where a package is missing.
        """
        if path.suffix not in KINDS:
            raise _core.ConfigError(f"--video {path}: the name ends in none of {', '.join(KINDS)}; choose another")
        if not 1 <= fps <= 50:
            raise _core.ConfigError(f"--fps {fps} is not between 1 and 50")
        if any(not 16 <= side <= MAX_SIDE or side % 2 for side in size):
            raise _core.ConfigError(
                f"--size {size[0]}x{size[1]}: the sides must be even, and from 16 to {MAX_SIDE} pixels"
            )
        package("PIL.Image", "drawing pictures", "play")
        if path.suffix == ".mp4":
            package("av", "writing MP4", "play")
        self.path, self.fps, self.size = path, fps, size
        self._frames: list[Image] = []
        self._expected = None if seconds is None else max(1, round(seconds * fps))
        self._told = time.monotonic()

    def add(self, image: "Image") -> None:
        """Takes the next frame."""
        self._frames.append(image)
        self._tell()

    def _tell(self) -> None:
        """Says which frame was drawn.

        A terminal gets all of them in the same line, other outputs one every `INTERVAL`.
        """
        of_all = "" if self._expected is None else f" of {max(self._expected, len(self._frames))}"
        text = f"{self.path.name}: frame {len(self._frames)}{of_all}"
        if sys.stderr.isatty():
            print(f"\r{text}", end="", file=sys.stderr, flush=True)
        elif time.monotonic() - self._told >= INTERVAL:
            self._told = time.monotonic()
            print(text, file=sys.stderr, flush=True)

    def close(self) -> None:
        """Writes the file, whole or not at all.

        Raises ConfigError where that fails, and for a film without frames.
        """
        if not self._frames:
            raise _core.ConfigError(f"--video {self.path}: there are no frames; ask for more --seconds")
        if sys.stderr.isatty():
            print(file=sys.stderr)
        write = {".gif": self._write_gif, ".webp": self._write_webp, ".mp4": self._write_mp4}[self.path.suffix]
        try:
            write_filled(self.path, write)
        except OSError as error:
            raise _core.ConfigError(f"cannot write {self.path}: {error.strerror}; choose another --video") from error

    def _write_gif(self, file: Any) -> None:
        # one palette for all frames: what does not change then has the same bytes
        module = package("PIL.Image", "drawing pictures", "play")
        some = self._frames[:: max(1, len(self._frames) // 4)][:4]
        sheet = module.new("RGB", (self.size[0], self.size[1] * len(some)))
        for index, frame in enumerate(some):
            sheet.paste(frame, (0, index * self.size[1]))
        palette = sheet.quantize(COLORS, method=module.Quantize.MEDIANCUT)
        frames = [frame.quantize(palette=palette, dither=module.Dither.NONE) for frame in self._frames]
        frames[0].save(
            file,
            format="GIF",
            save_all=True,
            append_images=frames[1:],
            duration=round(1000 / self.fps),
            loop=0,
            optimize=False,
            disposal=1,
        )

    def _write_webp(self, file: Any) -> None:
        self._frames[0].save(
            file,
            format="WEBP",
            save_all=True,
            append_images=self._frames[1:],
            duration=round(1000 / self.fps),
            loop=0,
            quality=70,
            method=4,
        )

    def _write_mp4(self, file: Any) -> None:
        av = package("av", "writing MP4", "play")
        with av.open(file, mode="w", format="mp4") as container:
            stream = container.add_stream("libx264", rate=self.fps)
            stream.width, stream.height = self.size
            stream.pix_fmt = "yuv420p"
            for image in self._frames:
                picture = av.VideoFrame.from_ndarray(np.asarray(image), format="rgb24")
                container.mux(stream.encode(picture))
            container.mux(stream.encode())
