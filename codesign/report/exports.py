"""Files of the winner next to the report: body, policy, film and recording."""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from softgym_envs.codesign.phases.finalists import policy_file
from softgym_envs.codesign.report.episodes import Episode
from softgym_envs.codesign.report.results import StudyResults
from softgym_envs.codesign.snapshot import StudySnapshot
from softgym_envs.errors import SoftGymError
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


def write_exports(
    snapshot: StudySnapshot, results: StudyResults, episodes: Sequence[Episode]
) -> tuple[list[Download], list[str]]:
    """Write the files of the winner: ``winner-trialNNNN.stl``, ``.step``, ``.onnx``, ``.gif`` and ``.rrd``.

    Existing files are kept; another winner has other files.

    Returns:
        The files, with the policy and the tables of results, and a line for each file that cannot exist.
    """
    folder, winner = snapshot.folder.path, results.winner
    if winner is None:
        return [_download(folder, name, text) for name, text in TABLES.items()], []
    robot = snapshot.config.environment_of(winner.options).make_robot()
    policy = policy_file(snapshot, winner)
    stem = f"winner-trial{winner.trial:04d}"
    files: list[tuple[str, str, Callable[[Path], object]]] = [
        (
            ".stl",
            "the winner's body at rest as triangles, in millimetres",
            lambda path: _body(robot, path, winner.design),
        ),
        (".step", "its exact shape for CAD, in millimetres", lambda path: _body(robot, path, winner.design)),
    ]
    if policy is not None:
        files.append(
            (".onnx", "its policy as an ONNX graph, from sensor values to commands", lambda path: _onnx(policy, path))
        )
    if episodes:
        files.append((".gif", "baseline and winner at one test goal", lambda path: write_film(path, episodes)))
    # Bodies with different options of the robot do not share a recording.
    if len(episodes) == 2 and episodes[0].robot.mechanics_key == episodes[1].robot.mechanics_key:
        files.append(
            (
                ".rrd",
                f"the same with all plots; open it with: softgym view {stem}.rrd",
                lambda path: _record(path, episodes),
            )
        )
    downloads, missing = [], []
    for ending, text, write in files:
        path = folder / f"{stem}{ending}"
        try:
            if not path.exists():
                write(path)
        except Exception as error:  # no exact shape, no ONNX, no OpenGL: the report is useful without the file
            expected = isinstance(error, (SoftGymError, ValueError))  # their messages say all
            missing.append(f"Not written: {path.name}: {'' if expected else f'{type(error).__name__}: '}{error}")
        else:
            downloads.append(_download(folder, path.name, text))
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


def _body(robot: Robot, path: Path, design: dict[str, float]) -> None:
    from softgym_envs.extensions.deployment.cad import export_body

    export_body(robot, path, design)


def _onnx(policy: Path, path: Path) -> None:
    from softgym_envs.extensions.deployment.policy_onnx import export_policy_onnx

    export_policy_onnx(policy, path)


def write_film(path: Path, episodes: Sequence[Episode]) -> None:
    """Write a film of episodes side by side; each holds its last image until the longest one ends."""
    from softgym_envs.viewer.image import ImageRenderer
    from softgym_envs.viewer.video import write_video

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
    from softgym_envs.viewer.recording import RolloutRecorder

    roles, scale = [episode.role for episode in episodes], episodes[0].task.distance_scale
    with RolloutRecorder(episodes[0].robot, path, roles=roles, distance_scale=scale) as recorder:
        for episode in episodes:
            recorder.begin(episode.role)
            for step, state in enumerate(episode.states):
                goals, goal = episode.drawn_goal(step)
                recorder.log(
                    step,
                    episode.design,
                    state,
                    goal,
                    path=goals,
                    reward=episode.rewards[step],
                    distance=episode.distances[step],
                )
