"""Films of rollouts."""

import numpy as np
import pytest
from PIL import Image, ImageSequence

from softgym_envs.extensions.recordings.films import write_video


@pytest.mark.parametrize("ending", ["gif", "webp"])
def test_animations(tmp_path, ending):
    frames = [np.full((33, 48, 3), 40 * k, dtype=np.uint8) for k in range(5)]
    path = write_video(tmp_path / f"film.{ending}", frames, fps=10.0)
    with Image.open(path) as film:
        seen = np.stack([np.asarray(image.convert("RGB")) for image in ImageSequence.Iterator(film)])
        assert film.info["loop"] == 0
    assert seen.shape == (5, 33, 48, 3)
    np.testing.assert_allclose(seen.mean(axis=(1, 2, 3)), 40 * np.arange(5), atol=8)


def test_a_film_of_odd_size_as_mp4(tmp_path):
    from imageio_ffmpeg import count_frames_and_secs

    frames = [np.full((33, 47, 3), 40 * k, dtype=np.uint8) for k in range(5)]
    path = write_video(tmp_path / "film.mp4", frames, fps=10.0)
    assert count_frames_and_secs(str(path)) == (5, 0.5)


def test_wrong_films(tmp_path):
    with pytest.raises(ValueError, match=r"must end with \.gif, \.webp or \.mp4"):
        write_video(tmp_path / "film.avi", [np.zeros((4, 4, 3), np.uint8)])
    with pytest.raises(ValueError, match="has no frames"):
        write_video(tmp_path / "film.gif", [])
