"""Files of the winner beside the report: its body for CAD and slicers, and a recording next to the baseline."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from codesign.folder import StudyFolder
from codesign.phases.finalists import Finalist, choose_winner, evaluations, fetch_policies, finalists

__all__ = ["write_exports"]


def write_exports(folder: StudyFolder) -> list[tuple[str, str]]:
    """Write ``winner-trialNNNN.stl`` and ``.rrd`` (baseline and winner side by side on the first unseen goal).

    What is there already is kept; another winner gets files of its own.

    Returns:
        Name and description of each file there is; none without a winner.
    """
    winner = choose_winner(folder, [record for record in evaluations(folder) if "error" not in record])
    if winner is None:
        return []
    baseline = next((body for body in finalists(folder) if body.role == "baseline"), None)
    stem = f"winner-trial{winner.number:04d}"
    files = [(f"{stem}.stl", "the winner's body at rest, in millimetres")]
    if not (folder.path / files[0][0]).exists():
        from softgym_envs.robots.geometry.export import export_body

        export_body(folder.config.robot, folder.path / files[0][0], winner.design)
    if baseline is not None:
        name = f"{stem}.rrd"
        files.append((name, "baseline and winner on the first unseen goal, side by side: softgym view " + name))
        if not (folder.path / name).exists():
            _record(folder, {"baseline": baseline, "winner": winner}, folder.path / name)
    return files


def _record(folder: StudyFolder, bodies: dict[str, Finalist], path: Path) -> None:
    from agents.evaluation import make_agent
    from softgym_envs.viewer.recording import record_comparison

    fetch_policies(folder)
    rollouts: dict[str, Any] = {}
    for role, body in bodies.items():
        agent = make_agent(folder.path / body.policy if body.policy else "qp")
        rollouts[role] = (agent, {"design": body.design, "goal": folder.goals["unseen"][0]})
    own = folder.config.environment
    if bodies["winner"].policy is None:  # the QP itself, not on top of another
        own = own.model_copy(update={"residual_scale": 0.0})
    env = own.make(sample_design=False)
    try:
        record_comparison(env, rollouts, path)
    finally:
        env.close()
