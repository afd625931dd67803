"""Give the winner of the search under the common gait three gaits of its own.

    softgym codesign --config studies/swimmer_swim/common_gait.yaml --folder results/common_gait
    python studies/swimmer_swim/body_first.py results/common_gait results/body_first
"""

from __future__ import annotations

import sys
from pathlib import Path

from swim import gait, speed

from softgym_envs.codesign import load_study
from softgym_envs.runs import provenance
from softgym_envs.storage import write_json

searched, folder = (Path(argument) for argument in sys.argv[1:])
best = max(load_study(searched).trials, key=lambda trial: trial.score)
design = {name: float(value) for name, value in best.design.items()}
found = [speed(gait(folder / str(seed), design, seed)[0], design) for seed in range(3)]
write_json(
    folder / "body_first.json",
    {"provenance": provenance(), "design": design, "common": speed("gait", design), "gradients": found},
)
