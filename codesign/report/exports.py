"""Files of the winner next to the report: its body for CAD and slicers, and a recording together with the baseline."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from codesign.phases.finalists import fetch_policies
from codesign.records import Finalist
from codesign.snapshot import StudySnapshot


def write_exports(snapshot: StudySnapshot) -> list[tuple[str, str]]:
    """Write ``winner-trialNNNN.stl`` and ``.rrd`` (baseline and winner side by side on the first unseen goal).

    Existing files are kept; another winner has other files.

    Returns:
        Name and description of each file; none without a winner.
    """
    winner, baseline, folder = snapshot.winner, snapshot.baseline, snapshot.folder
    if winner is None:
        return []
    stem = f"winner-trial{winner.trial:04d}"
    files = [(f"{stem}.stl", "the winner's body at rest, in millimetres")]
    if not (folder.path / files[0][0]).exists():
        from softgym_envs.robots.geometry.export import export_body

        robot = snapshot.config.environment_of(winner.options).make_robot()
        export_body(robot, folder.path / files[0][0], winner.design)
    # Bodies with different options of robot or task do not share an environment.
    if baseline is not None and baseline.options == winner.options:
        name = f"{stem}.rrd"
        files.append((name, "baseline and winner on the first unseen goal, side by side: softgym view " + name))
        if not (folder.path / name).exists():
            _record(snapshot, {"baseline": baseline, "winner": winner}, folder.path / name)
    return files


def _record(snapshot: StudySnapshot, bodies: dict[str, Finalist], path: Path) -> None:
    from agents.evaluation import make_agent
    from softgym_envs.viewer.recording import record_comparison

    fetch_policies(snapshot)
    folder = snapshot.folder
    rollouts: dict[str, Any] = {}
    for role, body in bodies.items():
        agent = make_agent(folder.path / body.policy if body.policy else "qp")
        rollouts[role] = (agent, {"design": body.design, "goal": folder.goals["unseen"][0]})
    environment = snapshot.config.environment_of(bodies["winner"].options)
    if bodies["winner"].policy is None:  # the QP alone, not on top of another one
        environment = environment.model_copy(update={"residual_scale": 0.0})
    env = environment.make(sample_design=False)
    try:
        record_comparison(env, rollouts, path)
    finally:
        env.close()
