"""Networks compared on the same data: error against the number of FEM states.

    python -m benchmarks.networks results/networks 2

makes the data (one body each: the Soft Finger with two cables and the Diamond, as in the thesis, sec. 4.3.1), trains
every network on parts of it in this many processes, and writes one JSON per run; it resumes. The runs
that this repository keeps are in ``benchmarks/data/networks.json``; ``softgym bench networks`` shows them.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from softgym_envs.config import provenance
from softgym_envs.storage import write_json

KEPT = Path(__file__).parent / "data" / "networks.json"

CASES: dict[str, dict[str, Any]] = {
    "finger": {
        "robot": "finger",
        "robot_options": {"cables": 2},
        "groups": 130,
        "margin": 0.1,
        "sizes": (50, 200, 800, 6400),
        "tracking": 500,
    },
    "diamond": {
        "robot": "diamond",
        "robot_options": {},
        "groups": 32,
        "margin": 1.0,
        "sizes": (50, 200, 1600),
        "tracking": 200,
    },
    "diamond that is only pulled": {
        "robot": "diamond",
        "robot_options": {},
        "groups": 135,
        "margin": 0.0,
        "sizes": (200, 6500),
        "tracking": None,
    },
    "gripper": {
        "robot": "three_finger_gripper",
        "robot_options": {},
        "groups": 24,
        "margin": 0.1,
        "sizes": (200, 1100),
        "tracking": None,
    },
}
"""Bodies; 50 states in each group. The Diamond's circle needs cables that push, so they are in its data. The third is
the thesis' own set: as many states, and cables that are pulled by 0 to 30 mm. The gripper is learned as a whole, three
fingers and their cube: W of a single finger, as in the thesis, is nearly singular in the states of a gripper, so a loss
on it says little."""


@dataclass(frozen=True)
class Row:
    """A network of the table.

    Attributes:
        options: options of its training; by default 4000 steps of 128 states.
        sizes: which of a case's numbers of states it learns from.
        seeds: number of seeds.
        cases: the bodies it learns; some networks take minutes for each.
        validated: its best step is chosen on 200 additional validation states of the body; otherwise on the training
            states.
    """

    options: dict[str, Any]
    sizes: Literal["every", "200 and all", "all"] = "every"
    seeds: int = 3
    cases: tuple[str, ...] = tuple(CASES)
    validated: bool = True

    def runs(self, case: str) -> list[tuple[int, int]]:
        """Numbers of states and seeds."""
        sizes = CASES[case]["sizes"]
        chosen = {"every": sizes, "200 and all": (200, sizes[-1]), "all": sizes[-1:]}[self.sizes]
        return [(size, seed) for seed in range(self.seeds) for size in chosen] if case in self.cases else []


NETWORKS: dict[str, Row] = {
    "potential": Row({"kind": "potential", "members": 1}),
    "residual": Row({"kind": "residual"}, "200 and all"),
    "thesis": Row({"kind": "thesis", "steps": 4000, "batch_size": 128}),
    "rbf": Row({"kind": "rbf"}, "200 and all"),
    "potential, Adam": Row(
        {"kind": "potential", "members": 1, "optimiser": "adam", "learning_rate": 3e-3}, "all", 1, ("finger", "diamond")
    ),
    "potential, no validation": Row(
        {"kind": "potential", "members": 1}, seeds=1, cases=("finger", "diamond"), validated=False
    ),
    "thesis, 5 times the steps": Row({"kind": "thesis", "steps": 20_000, "batch_size": 256}, "all", 1, ("finger",)),
    "potential x 5": Row({"kind": "potential", "members": 5}, "all", 1, ("finger",)),
    "thesis, SOAP": Row(
        {"kind": "thesis", "optimiser": "soap", "steps": 4000, "batch_size": 128}, "all", 1, ("finger", "diamond")
    ),
}
"""The thesis' network is trained by Adam as published, and by SOAP as ours are."""


def standardised_loss(model: Any, training: dict[str, np.ndarray], test: dict[str, np.ndarray]) -> float:
    """The test loss of the thesis: mean squared error of all entries of W and delta_free, in units of their spread."""
    from softgym_envs.surrogate.data.states import full_compliance, stable_rows

    training, test = (
        {k: v[stable] for k, v in data.items()}
        for data, stable in ((d, stable_rows(model.robot, d)) for d in (training, test))
    )
    rows, columns = np.triu_indices(model.size)

    def outputs(W, effort, displacement, effector):
        full = np.concatenate([effort, np.zeros_like(effector)], axis=1)
        delta = np.concatenate([displacement, effector], axis=1)
        return np.concatenate([W[:, rows, columns], delta - np.einsum("bij,bj->bi", W, full)], axis=1)

    def truth(data):
        W = full_compliance(data["compliance"], model.size)
        return outputs(W, data["effort"], data["displacement"], data["effector"])

    context = model.context(test["design"])
    effort, effector, _ = model.state(context, test["displacement"])
    predicted = outputs(model.compliance(context, test["displacement"]), effort, test["displacement"], effector)
    spread = truth(training).std(axis=0)
    varies = spread > 1e-9 * np.abs(truth(training)).max(axis=0)
    return float((((predicted - truth(test))[:, varies] / spread[varies]) ** 2).mean())


def _data(folder: Path, case: str, workers: int) -> dict[str, dict[str, np.ndarray]]:
    from softgym_envs.surrogate.data.dataset import generate_dataset
    from softgym_envs.surrogate.data.sampling import SamplingPlan

    given = CASES[case]
    plans = {
        "train": SamplingPlan(given["groups"], 50, "halton", 0, given["margin"], vary=()),
        "validation": SamplingPlan(4, 50, "random", 1, given["margin"], vary=()),
        "test": SamplingPlan(10, 50, "random", 2, given["margin"], vary=()),
    }
    return {
        split: generate_dataset(
            folder / case.replace(" ", "") / split,
            given["robot"],
            plan,
            robot_options=given["robot_options"],
            groups_per_shard=2,
            workers=workers,
        )
        for split, plan in plans.items()
    }


def _run(path: Path, case: str, name: str, data: dict[str, dict[str, np.ndarray]], size: int, seed: int) -> Path:
    import torch

    from softgym_envs.robots.registry import make_robot
    from softgym_envs.surrogate.data.states import training_states
    from softgym_envs.surrogate.features import Features
    from softgym_envs.surrogate.networks import network_module
    from softgym_envs.surrogate.trainer import Trainer
    from softgym_envs.surrogate.training import measure_errors

    torch.set_num_threads(1)
    robot = make_robot(CASES[case]["robot"], **CASES[case]["robot_options"])
    features = Features(robot)
    # One rest state and ``size`` others, drawn anew for each seed.
    others = np.flatnonzero(~data["train"]["rest"].astype(bool))
    chosen = np.concatenate([[0], np.random.default_rng(seed).permutation(others)[:size]])
    part = {k: v[chosen] for k, v in data["train"].items()}
    options = NETWORKS[name].options
    module = network_module(options["kind"])
    start = time.process_time()
    tensors, _ = module.train(
        robot,
        training_states(robot, part, features),
        training_states(robot, data["validation"] if NETWORKS[name].validated else part, features),
        Trainer(module.Options(**options), seed),
    )
    seconds = time.process_time() - start
    model = module.Model(robot, tensors, {})
    errors = measure_errors(model, data["test"])
    one = model.context(data["test"]["design"][:1])
    row = data["test"]["displacement"][:1]
    model.state(one, row)
    laps = []
    for _ in range(200):
        start = time.perf_counter()
        model.state(one, row)
        laps.append(time.perf_counter() - start)
    result = {
        **errors,
        "case": case,
        "network": name,
        "states": int(size),  # it learned from, beside the rest state
        "seed": seed,
        "loss": standardised_loss(model, data["train"], data["test"]),
        "training_cpu_seconds": seconds,
        "microseconds_per_state": 1e6 * float(np.median(laps)),
        "numbers": int(sum(v.size for v in tensors.values())),
    }
    write_json(path, result)
    return path


def _track(path: Path, case: str, data: dict[str, dict[str, np.ndarray]], size: int, folder: Path) -> Path:
    """Tracking with a network that learned ``size`` states chosen by k-means (thesis, sec. 5.3)."""
    import torch

    from benchmarks.robots import predicted_path
    from softgym_envs.robots.registry import make_robot
    from softgym_envs.surrogate import potential
    from softgym_envs.surrogate.data.sampling import select_states
    from softgym_envs.surrogate.data.states import stable_rows, training_states
    from softgym_envs.surrogate.features import Features
    from softgym_envs.surrogate.trainer import Trainer
    from softgym_envs.surrogate.weight_files import card_of, save_model

    torch.set_num_threads(1)
    robot = make_robot(CASES[case]["robot"], **CASES[case]["robot_options"])
    features = Features(robot)
    usable = np.flatnonzero(stable_rows(robot, data["train"]) & ~data["train"]["rest"].astype(bool))
    pool = {k: v[usable] for k, v in data["train"].items()}
    chosen = np.concatenate([[0], usable[select_states(pool, size - 1)]])
    part = {k: v[chosen] for k, v in data["train"].items()}
    options = potential.Options(members=1)
    states = {k: training_states(robot, d, features) for k, d in (("t", part), ("v", data["validation"]))}
    tensors, _ = potential.train(robot, states["t"], states["v"], Trainer(options, 0))
    card = card_of(robot, "potential")
    save_model(potential.Model(robot, tensors, card), folder)
    track = {**CASES[case]["robot_options"], **({"unilateral": False} if case == "diamond" else {})}
    found = predicted_path(CASES[case]["robot"], options=track, weights=folder)
    write_json(path, {"case": case, "states": size, **found})
    return path


def main(folder: Path, workers: int = 1) -> None:
    """Train what is missing, and write all runs to ``benchmarks/data/networks.json``, even if interrupted."""
    from softgym_envs.executors import parallel_map

    runs = folder / "runs"
    tracks: list[tuple] = []
    trainings: list[tuple] = []
    data = {case: _data(folder / "data", case, workers) for case in CASES}
    for case, given in CASES.items():
        if given["tracking"]:
            path = runs / f"{case}_tracking.json"
            tracks.append((path, case, data[case], given["tracking"], folder / "models" / case))
    for name, row in NETWORKS.items():
        for case in CASES:
            stem = f"{case.replace(' ', '')}_{name.replace(' ', '').replace(',', '_')}"
            trainings += [
                (runs / f"{stem}_{size}_{seed}.json", case, name, data[case], size, seed)
                for size, seed in row.runs(case)
            ]
    try:
        for function, rows in ((_track, tracks), (_run, trainings)):
            for path in parallel_map(function, [row for row in rows if not row[0].exists()], workers):
                last = json.loads(path.read_text())
                if "network" in last:
                    print(
                        f"{last['case']:8s} {last['network']:14s} {last['states']:5d} states, seed {last['seed']}: "
                        f"effector {1e3 * last['effector_mean']:.4f} mm, loss {last['loss']:.2e}",
                        flush=True,
                    )
    finally:
        found = [json.loads(path.read_text()) for path in sorted(runs.glob("*.json"))]
        trained, tracked = [r for r in found if "network" in r], [r for r in found if "network" not in r]
        write_json(KEPT, {**provenance(), "runs": trained, "tracking": tracked})


def networks() -> dict[str, object]:
    """Test errors of the networks by number of states: median of three seeds (smallest to largest)."""
    kept = json.loads(KEPT.read_text())
    runs = kept["runs"]
    result: dict[str, object] = {}
    for track in kept["tracking"]:
        name = f"{track['case']}, {track['states']} states chosen by k-means"
        result |= {f"{name}: {k}": v for k, v in track.items() if k not in ("case", "states")}
    for case in CASES:
        for name in NETWORKS:
            for size in CASES[case]["sizes"]:
                found = [r for r in runs if (r["case"], r["network"], r["states"]) == (case, name, size)]
                if not found:
                    continue
                key = f"{case}, {name}, {size} states"
                for label, column, unit in (
                    ("effector error, mean [mm]", "effector_mean", 1e3),
                    ("loss as in the thesis", "loss", 1.0),
                    ("W error, median [%]", "compliance_median", 1e2),
                ):
                    values = sorted(unit * r[column] for r in found)
                    result[f"{key}: {label}"] = (
                        f"{np.median(values):.3g} ({values[0]:.3g} to {values[-1]:.3g})"
                        if len(values) > 1
                        else f"{values[0]:.3g}"
                    )
                result[f"{key}: training [CPU s]"] = float(np.median([r["training_cpu_seconds"] for r in found]))
        result |= _factor(case, [r for r in runs if r["case"] == case])
    return result


def _factor(case: str, runs: list[dict[str, Any]]) -> dict[str, object]:
    """How many times fewer states the potential network needs to match the best error of the thesis' network."""

    def curve(name):
        sizes = sorted({r["states"] for r in runs if r["network"] == name})
        return sizes, [
            np.median([r["effector_mean"] for r in runs if (r["network"], r["states"]) == (name, s)]) for s in sizes
        ]

    sizes, errors = curve("thesis")
    best = int(np.argmin(errors))
    ours, reached = curve("potential")
    enough = [s for s, e in zip(ours, reached, strict=True) if e <= errors[best]]
    if not enough:
        return {f"{case}: states of the potential network for the thesis network's best error": "not reached"}
    return {
        f"{case}: times fewer states for the thesis network's best error (at {sizes[best]})": sizes[best] / enough[0]
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", default=Path("results/networks"))
    parser.add_argument("workers", type=int, nargs="?", default=1, help="number of processes")
    main(**vars(parser.parse_args()))
