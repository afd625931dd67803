"""Films of rollouts as ``.gif``, ``.webp`` (Pillow) or ``.mp4`` (ffmpeg)."""

from __future__ import annotations

import errno
import io
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

from softgym_envs.extras import require
from softgym_envs.storage import atomic_write
from softgym_envs.viewer.moment import Moment

if TYPE_CHECKING:
    from softgym_envs.envs.env import SoftRobotEnv

FORMATS = (".gif", ".webp", ".mp4")
"""Allowed file endings."""
GIF_COLORS = 128


class FilmWriter:
    """Writes pictures of one rollout as a film; a context manager: the file does not exist if the block fails.

    Args:
        env: environment with ``render_mode="rgb_array"``.
        path: the film, see `write_video`.

    Raises:
        ValueError: as `write_video`.
        MissingLibrary: as `write_video`.
    """

    def __init__(self, env: SoftRobotEnv, path: str | Path) -> None:
        self.env, self.path = env, check_video(path)
        self._frames: list[Any] = []

    def __enter__(self) -> FilmWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            write_video(self.path, self._frames, fps=self.env.metadata["render_fps"])

    def log(self, moment: Moment, /) -> None:
        """Draw the environment as it is now."""
        self._frames.append(self.env.render())


def write_video(path: str | Path, frames: Sequence[np.ndarray], fps: float = 20.0) -> Path:
    """Write images as a film, whole or not at all.

    Args:
        path: the file; its ending decides the format. ``.gif`` and ``.webp`` repeat for ever.
        frames: images of one size, each (height, width, 3) uint8. In an ``.mp4`` an odd last row or column is left out.
        fps: frames per second. A ``.gif`` counts in hundredths of a second.

    Raises:
        ValueError: for another ending, or no frames.
        MissingLibrary: for an ``.mp4`` without the extra ``video``.
    """
    path = check_video(path)
    if not len(frames):
        raise ValueError(f"film '{path}' has no frames")
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as stream:
        stream.write(_mp4(frames, fps) if path.suffix == ".mp4" else animation(frames, fps, path.suffix[1:]))
    return path


def check_video(path: str | Path) -> Path:
    """Return the path of a film that can be written here.

    Raises:
        ValueError: as `write_video`.
    """
    path = Path(path)
    if path.suffix not in FORMATS:
        raise ValueError(f"film '{path}' must end with {', '.join(FORMATS[:-1])} or {FORMATS[-1]}")
    if path.suffix == ".mp4":
        require("video")
    return path


def animation(frames: Sequence[np.ndarray], fps: float, kind: str = "gif") -> bytes:
    """Return images (height, width, 3) uint8 as an animated ``"gif"`` or ``"webp"`` that repeats for ever."""
    from PIL import Image

    images = [Image.fromarray(frame) for frame in frames]
    options: dict[str, object] = {"quality": 75, "method": 4}
    if kind == "gif":
        # One palette without dithering: still parts stay equal from frame to frame, which keeps the file small.
        some = np.linspace(0, len(frames) - 1, 5).round().astype(int)
        montage = Image.fromarray(np.concatenate([frames[k] for k in some]))
        palette = montage.quantize(GIF_COLORS, Image.Quantize.MAXCOVERAGE)
        images = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
        options = {"optimize": True}
    stream = io.BytesIO()
    duration = round(1e3 / fps)
    images[0].save(stream, format=kind, save_all=True, append_images=images[1:], duration=duration, loop=0, **options)
    return stream.getvalue()


def _mp4(frames: Sequence[np.ndarray], fps: float) -> bytes:
    from imageio_ffmpeg import count_frames_and_secs, write_frames

    height, width = (n - n % 2 for n in frames[0].shape[:2])
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "film.mp4"
        # H.264 with 4:2:0 colours, which every browser plays, needs even sizes.
        writer = write_frames(str(file), (width, height), fps=fps, codec="libx264", macro_block_size=2)
        writer.send(None)
        for frame in frames:
            writer.send(np.ascontiguousarray(frame[:height, :width]))
        writer.close()
        with suppress(RuntimeError):  # of a film that cannot be read
            if count_frames_and_secs(str(file))[0] == len(frames):
                return file.read_bytes()
    # ffmpeg itself leaves films incomplete, without a word, where the disk is full.
    raise OSError(errno.ENOSPC, "the film is incomplete; is the temporary folder full?", folder)
