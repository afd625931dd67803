"""Throws of the baseline, the winner and the body found under the common throw: three starts, finer, heavier.

    softgym codesign --config whip_throw --folder results/whip_search
    softgym codesign --config studies/whip_throw/common_throw.yaml --folder results/common_throw
    python studies/whip_throw/robust.py results/whip_search results/common_throw results/whip_robust

Each body gets three throws of its own along gradients, on which it is also tested with four elements per segment and
with time steps of 1 ms; and one of its own for heavier payloads.
"""

from __future__ import annotations

import sys
from pathlib import Path

from throw import OTHERS, gait, reach

from softgym_envs.codesign import load_study
from softgym_envs.robots.registry import make_robot
from softgym_envs.runs import provenance
from softgym_envs.storage import write_json

searched, common, folder = (Path(argument) for argument in sys.argv[1:])


def best(study: Path) -> dict[str, float]:
    scored = [trial for trial in load_study(study).trials if trial.score is not None]
    return {name: float(value) for name, value in max(scored, key=lambda trial: trial.score).design.items()}


finer, shorter, heavier = OTHERS
bodies = {"baseline": dict(make_robot("whip").design_space.baseline), "common": best(common), "winner": best(searched)}
found = {}
for name, design in bodies.items():
    paths = [gait(folder / f"{name}_{seed}", design, seed)[0] for seed in range(3)]
    found[name] = {
        "design": design,
        "common": reach("gait", design),
        "gradients": [reach(path, design) for path in paths],
        "finer": [reach(path, design, **finer) for path in paths],
        "shorter": [reach(path, design, **shorter) for path in paths],
        "heavier": reach(gait(folder / f"{name}_heavier", design, **heavier)[0], design, **heavier),
    }
    print(name, found[name], flush=True)
write_json(folder / "robust.json", {"provenance": provenance(), "bodies": found})
