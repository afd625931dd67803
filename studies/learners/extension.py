"""Trainings that are extended: a quarter of the steps, the rest later, and all steps at once."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from softgym_envs.config import load_config

CONFIG = Path(__file__).parent.parent / "configs" / "agents" / "trunk_reach_analytic.yaml"
SEEDS = (0, 1, 2)


def extension() -> dict[str, object]:
    """Goals that policies of the trunk reach after a quarter of the steps, extended to all, and trained at once."""
    from softgym_envs.agents.config import TrainConfig
    from softgym_envs.agents.policy import Policy
    from softgym_envs.agents.training import train

    config = load_config(CONFIG, TrainConfig)

    def reached(folder: Path, seed: int, steps: int) -> float:
        planned = config.model_copy(update={"seed": seed, "steps": steps})
        policy = train(planned, folder, progress=False, keep_checkpoint=True)
        kept = max(Policy(policy).card["curve"], key=lambda point: point["mean_return"])
        return 100.0 * kept["success_rate"]

    result: dict[str, object] = {"steps": config.steps}
    for seed in SEEDS:
        with TemporaryDirectory() as name:
            folder = Path(name)
            result[f"seed {seed}, a quarter: goals reached [%]"] = reached(folder / "extended", seed, config.steps // 4)
            result[f"seed {seed}, extended: goals reached [%]"] = reached(folder / "extended", seed, config.steps)
            result[f"seed {seed}, at once: goals reached [%]"] = reached(folder / "at_once", seed, config.steps)
    return result
