"""Files of the winner next to the report: body, policy, film and recording."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from softgym_envs.codesign.phases.finalists import policy_file
from softgym_envs.codesign.results import StudyResults
from softgym_envs.codesign.snapshot import StudySnapshot
from softgym_envs.errors import SoftGymError
from softgym_envs.extensions.report.episodes import Episode
from softgym_envs.registry import Table
from softgym_envs.robots.base import Robot

EMBEDDED = 1_000_000
"""Largest file that the report contains itself [bytes]; larger ones are links to the folder of the study."""
FILM_FRAMES, FILM_SIZE = 30, (380, 380)
TABLES = {
    "trials.csv": "every body of the search, in SI units",
    "finalists.csv": "every test of the finalists, in SI units",
    "results.json": "all numbers of this report, in SI units",
}


@dataclass(frozen=True)
class Download:
    """A file of a report.

    Attributes:
        name: its path relative to the report.
        text: what it is.
        size: its size [bytes].
        href: what the report links to: the content of a small file, else its name.
    """

    name: str
    text: str
    size: int
    href: str


@dataclass(frozen=True)
class Winner:
    """What files of the winner are made of: its robot and design, its policy if it has one, episodes at test goals."""

    robot: Robot
    design: Mapping[str, float]
    policy: Path | None
    episodes: Sequence[Episode]


@dataclass(frozen=True)
class WinnerFile:
    """A file that a report can write of its winner.

    Attributes:
        ending: of its name, which says what it holds: ``".stl"``.
        text: what it is.
        write: writes it to a path.
        exists: whether a winner has such a file.
    """

    ending: str
    text: str
    write: Callable[[Path, Winner], object]
    exists: Callable[[Winner], bool] = lambda winner: True


def write_exports(
    snapshot: StudySnapshot, results: StudyResults, episodes: Sequence[Episode]
) -> tuple[list[Download], list[str]]:
    """Write the files of the winner (`WINNER_FILES`): ``winner-trialNNNN.gif``, ``.rrd`` and others.

    Existing files are kept; another winner has other files.

    Returns:
        The files, with the policy and the tables of results, and a line for each file that cannot exist.
    """
    folder, winner = snapshot.folder.path, results.winner
    if winner is None:
        return [_download(folder, name, text) for name, text in TABLES.items()], []
    robot = snapshot.config.environment_of(winner.options).make_robot()
    policy = policy_file(snapshot, winner)
    shown = Winner(robot, winner.design, policy, episodes)
    stem = f"winner-trial{winner.trial:04d}"
    downloads, missing = [], []
    for file in WINNER_FILES.values():
        if not file.exists(shown):
            continue
        path = folder / f"{stem}{file.ending}"
        try:
            if not path.exists():
                file.write(path, shown)
        except Exception as error:  # no exact shape, no ONNX, no OpenGL: the report is useful without the file
            expected = isinstance(error, (SoftGymError, ValueError))  # their messages say all
            missing.append(f"Not written: {path.name}: {'' if expected else f'{type(error).__name__}: '}{error}")
        else:
            downloads.append(_download(folder, path.name, file.text))
    if policy is not None:
        text = "its policy; softgym evaluate and softgym rollout --agent take it together with the .json beside it"
        downloads.append(_download(folder, policy.relative_to(folder).as_posix(), text))
    return downloads + [_download(folder, name, text) for name, text in TABLES.items()], missing


def _download(folder: Path, name: str, text: str) -> Download:
    size = (folder / name).stat().st_size
    if size > EMBEDDED:
        return Download(name, text, size, name)
    content = base64.b64encode((folder / name).read_bytes()).decode()
    return Download(name, text, size, f"data:application/octet-stream;base64,{content}")


def write_film(path: Path, episodes: Sequence[Episode]) -> None:
    """Write a film of episodes side by side; each holds its last image until the longest one ends."""
    from softgym_envs.extensions.recordings.films import write_video
    from softgym_envs.viewer.image import ImageRenderer

    films = []
    for episode in episodes:
        renderer = ImageRenderer(episode.robot, FILM_SIZE)
        try:
            films.append(
                [
                    renderer.render(
                        episode.design,
                        episode.states[index],
                        *episode.drawn_goal(index),
                        text=f"{episode.role}: {episode.distance_text(index)}",
                    )
                    for index in episode.pick(FILM_FRAMES)
                ]
            )
        finally:
            renderer.close()
    length = max(map(len, films))
    rows = [np.concatenate([film[min(k, len(film) - 1)] for film in films], axis=1) for k in range(length)]
    write_video(path, rows + [rows[-1]] * 10, fps=10.0)  # a second to look at the end


def _record(path: Path, episodes: Sequence[Episode]) -> None:
    from softgym_envs.extensions.recordings.rerun_file import RolloutRecorder
    from softgym_envs.viewer.moment import Moment

    roles, scale = [episode.role for episode in episodes], episodes[0].task.distance_scale
    with RolloutRecorder(episodes[0].robot, path, roles=roles, distance_scale=scale) as recorder:
        for episode in episodes:
            recorder.begin(episode.role)
            for step, state in enumerate(episode.states):
                goals, goal = episode.drawn_goal(step)
                reward, distance = episode.rewards[step], episode.distances[step]
                recorder.log(Moment(step, episode.design, state, goal, goals, reward, distance))


def _comparable(winner: Winner) -> bool:
    """Whether baseline and winner share a recording: bodies with different options of the robot do not."""
    keys = [episode.robot.mechanics_key for episode in winner.episodes]
    return len(keys) == 2 and keys[0] == keys[1]


FILM = WinnerFile(
    ".gif",
    "baseline and winner at one test goal",
    lambda path, winner: write_film(path, winner.episodes),
    lambda winner: bool(winner.episodes),
)
RECORDING = WinnerFile(
    ".rrd",
    "the same with all plots; open it with: softgym view FILE",
    lambda path, winner: _record(path, winner.episodes),
    _comparable,
)
WINNER_FILES = Table("file of the winner", {"film": FILM, "recording": RECORDING}, group="softgym_envs.winner_files")
"""Files of the winner by what they are: those of the report itself and of installed packages, each a `WinnerFile`."""
