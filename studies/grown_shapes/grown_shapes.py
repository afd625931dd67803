"""Fingers grown from examples: a latent space of side views against seven parameters, at an equal number of bodies.

``python -m benchmarks.grown_shapes FOLDER`` trains the variational autoencoder, searches with both for three seeds of
300 bodies each, and writes ``benchmarks/data/grown_shapes.json``; what is in FOLDER is not computed again. With
``--quality`` only what the autoencoder is worth is measured, and replaced in that file.

A finger is a side view, extruded to the width of the Soft Finger. The side view is where a function of the place along
the finger (s) and across it (y) is negative: near its surface the signed distance. Examples have one to four notches,
round or sharp, and holes. Two objectives, both to be large: how far the tip moves when the cable is pulled, and how
stiff it is with the cable held.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from benchmarks.tables import markdown
from softgym_envs.config import provenance
from softgym_envs.errors import ConvergenceError, DataError, InfeasibleDesign, SoftGymError
from softgym_envs.mechanics.model import MechanicalModel
from softgym_envs.storage import write_json

KEPT = Path(__file__).parent / "data" / "grown_shapes.json"
SEEDS = (0, 1, 2)
LENGTH, HALF_WIDTH, MODULUS, POISSON = 120.0, 8.75, 3.0e6, 0.3
"""Length and half of the width [mm], Young's modulus [Pa] and Poisson's ratio, all of the Soft Finger."""
PULL = 6.0e-3
"""Pull of the cable [m]."""
COVER = 3.0
"""Depth of the cable under the ends of the top side [mm]."""
ACROSS, ALONG = np.linspace(-4.0, 28.0, 17), np.linspace(0.0, LENGTH, 61)
"""Places of the signed distances of an example [mm]."""
DEEPEST = 6.0
"""Signed distances are cut off here [mm]."""
LATENT, LATENT_BOUND = 8, 3.0
"""Dimension of the latent space, and bounds of the search there; places of examples have a deviation of about 1.9."""
SAMPLES = 100
"""Of the latent space, of which the share that meshes and solves is measured."""
CELL = 3.0
"""Distance of the nodes of the mesh [mm]."""
PARAMETERS = {
    "base height": (14.0, 24.0),
    "tip height": (14.0, 24.0),
    "joint 1": (3.0, 8.0),
    "joint 2": (3.0, 8.0),
    "place 1": (25.0, 55.0),
    "place 2": (65.0, 95.0),
    "slope": (0.3, 1.0),
}
"""The seven parameters, with bounds [mm]; the slope is the tangent of half of the angle of a notch."""
BASELINE = np.array([20.0, 20.0, 6.0, 6.0, 40.0, 80.0, 0.577])


def bar(base: float, tip: float) -> np.ndarray:
    """Return the signed distances of a bar that tapers, shape (y, s)."""
    y, s = np.meshgrid(ACROSS, ALONG, indexing="ij")
    return np.maximum(-y, y - base - (tip - base) * s / LENGTH)


def notched(body: np.ndarray, place: float, joint: float, slope: float, round_off: float = 0.0) -> np.ndarray:
    """Return a body with a notch from above, whose ground is ``joint`` above the bottom and rounded by a radius."""
    y, s = np.meshgrid(ACROSS, ALONG, indexing="ij")
    above = y - joint - round_off
    wedge = (np.abs(s - place) - slope * above) / np.hypot(1.0, slope) - round_off
    disc = np.hypot(s - place, above) - round_off
    return np.maximum(body, -np.where(above < 0.0, disc, wedge) if round_off else -wedge)


def seven_parameters(x: np.ndarray) -> np.ndarray:
    """Return the signed distances of the finger with seven parameters: two sharp notches in a bar that tapers."""
    base, tip, first, second, near, far, slope = x
    return notched(notched(bar(base, tip), near, first, slope), far, second, slope)


def example(rng: np.random.Generator) -> np.ndarray:
    """Draw a finger of the family of examples."""
    base, tip = rng.uniform(14.0, 24.0, 2)
    body = bar(base, tip)
    count = int(rng.integers(1, 5))
    places = (np.arange(count) + 0.5 + rng.uniform(-0.25, 0.25, count)) * 100.0 / count + 10.0
    for place in places:
        joint, kind = rng.uniform(3.0, 8.0), rng.integers(3)
        if kind < 2:
            body = notched(body, place, joint, rng.uniform(0.1, 1.0), rng.uniform(1.5, 4.0) if kind else 0.0)
        else:
            y, s = np.meshgrid(ACROSS, ALONG, indexing="ij")
            low, high = joint, base + (tip - base) * place / LENGTH - rng.uniform(3.0, 5.0)
            a, b = rng.uniform(4.0, 9.0), max(0.5 * (high - low), 2.0)
            hole = (np.hypot((s - place) / a, (y - low - b) / b) - 1.0) * min(a, b)
            body = np.maximum(body, -hole)
    return body


def side_mesh(distance: np.ndarray) -> tuple[np.ndarray, np.ndarray, RectBivariateSpline]:
    """Mesh a side view: nodes (n, 2) as (y, s) [mm], triangles (m, 3), and the smooth function.

    Nodes of a regular mesh that are near the surface are moved onto it; triangles that it still crosses are cut.

    Raises:
        InfeasibleDesign: if the finger does not lead from the base to the tip in one piece.
    """
    smooth = RectBivariateSpline(ACROSS, ALONG, distance)
    rows, columns = round(np.ptp(ACROSS) / CELL) + 1, round(LENGTH / CELL) + 1
    y, s = np.meshgrid(np.linspace(ACROSS[0], ACROSS[-1], rows), np.linspace(0.0, LENGTH, columns), indexing="ij")
    points = np.column_stack([y.ravel(), s.ravel()])
    number = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (number[i : rows - 1 + i, j : columns - 1 + j].ravel() for i, j in ((0, 0), (1, 0), (1, 1), (0, 1)))
    even = (np.add.outer(np.arange(rows - 1), np.arange(columns - 1)).ravel() % 2 == 0)[:, None]
    cells = np.concatenate(
        [
            np.where(even, np.column_stack([a, b, c]), np.column_stack([a, b, d])),
            np.where(even, np.column_stack([a, c, d]), np.column_stack([b, c, d])),
        ]
    )
    value = smooth.ev(points[:, 0], points[:, 1])
    edges = np.unique(np.sort(np.concatenate([cells[:, [0, 1]], cells[:, [1, 2]], cells[:, [2, 0]]]), axis=1), axis=0)
    crossed = edges[value[edges[:, 0]] * value[edges[:, 1]] < 0.0]
    end = np.isin(points[:, 1], (0.0, LENGTH))
    best = np.full(len(points), 0.3)
    moved = points.copy()
    for one, two in np.concatenate([crossed, crossed[:, ::-1]]):
        share = value[one] / (value[one] - value[two])
        if share < best[one] and (end[two] or not end[one]):
            best[one], moved[one] = share, points[one] + share * (points[two] - points[one])
    value = np.where(best < 0.3, 0.0, value)
    points = list(moved)
    cuts: dict[tuple[int, int], int] = {}

    def cut(inside: int, outside: int) -> int:
        key = (inside, outside)
        if key not in cuts:
            share = min(max(value[inside] / (value[inside] - value[outside]), 0.15), 0.85)
            cuts[key] = len(points)
            points.append(moved[inside] + share * (moved[outside] - moved[inside]))
        return cuts[key]

    triangles = []
    for cell in cells:
        signs = value[cell]
        if not (signs < 0.0).any():
            continue
        outline = []
        for here, there in zip(cell, np.roll(cell, -1), strict=True):
            if value[here] <= 0.0:
                outline.append(int(here))
            if value[here] * value[there] < 0.0:
                outline.append(cut(here, there) if value[here] < 0.0 else cut(there, here))
        triangles += [[outline[0], outline[k], outline[k + 1]] for k in range(1, len(outline) - 1)]
    return (*_one_piece(np.array(points), np.array(triangles, dtype=np.int64).reshape(-1, 3)), smooth)


def _one_piece(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the piece, connected over edges, that leads from the base to the tip.

    Where parts of it touch in one node only, a wall would have no thickness: the triangles around the node are removed,
    which opens a hole to the outside, for example.
    """
    kept, pinched = _through_piece(points, triangles)
    while len(pinched):
        kept, pinched = _through_piece(points, kept[~np.isin(kept, pinched).any(axis=1)])
    used, again = np.unique(kept, return_inverse=True)
    return points[used], again.reshape(-1, 3)


def _through_piece(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangles of the piece that leads from the base to the tip, and nodes where its parts only touch."""
    if len(triangles) == 0:
        raise InfeasibleDesign("the side view is empty")
    sides = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    owner = np.tile(np.arange(len(triangles)), 3)
    order = np.lexsort(sides.T)
    same = (np.diff(sides[order], axis=0) == 0).all(axis=1)
    graph = coo_matrix((np.ones(same.sum()), (owner[order][:-1][same], owner[order][1:][same])), (len(triangles),) * 2)
    _, label = connected_components(graph, directed=False)
    for piece in np.argsort(-np.bincount(label)):
        kept = triangles[label == piece]
        along = points[kept.ravel(), 1]
        if along.min() < 1e-9 and along.max() > LENGTH - 1e-9:
            single = ~(np.append(same, False) | np.insert(same, 0, False)) & (label[owner[order]] == piece)
            ends = np.bincount(sides[order][single].ravel())
            return kept, np.flatnonzero(ends > 2)
    raise InfeasibleDesign("no piece of the finger leads from the base to the tip")


def build(distance: np.ndarray) -> MechanicalModel:
    """Return the model of half a finger: clamped base, symmetric about x = 0, cable and tip by rule.

    The cable runs straight, `COVER` under the ends of the top side, through all material on its way. Quadratic
    tetrahedra. The effort is that of half of the cable.

    Raises:
        InfeasibleDesign: if the body is not in one piece, or the cable has no material at the base or the tip.
    """
    side, triangles, smooth = side_mesh(distance)
    fine = np.linspace(ACROSS[0], ACROSS[-1], 321)
    tops = []
    for s in (0.0, LENGTH):
        inside = fine[smooth.ev(fine, np.full(fine.shape, s)) < 0.0]
        if len(inside) == 0 or np.ptp(inside) < 2.0 * COVER:
            raise InfeasibleDesign(f"the finger is thinner than {2.0 * COVER:g} mm at one end")
        tops.append((inside.min(), inside.max()))
    stations = np.linspace(1.0, LENGTH - 1.0, 237)
    line = np.interp(stations, [0.0, LENGTH], [top - COVER for _, top in tops])
    within = smooth.ev(line, stations) < -0.5
    starts = np.flatnonzero(np.diff(within.astype(int), prepend=0) == 1)
    stops = np.flatnonzero(np.diff(within.astype(int), append=0) == -1)
    guides = [k for a, b in zip(starts, stops, strict=True) if b - a >= 6 for k in (a, b)]
    if not guides or stations[guides[-1]] < LENGTH - 10.0:
        raise InfeasibleDesign("the cable finds no material at the tip")

    # One layer of prisms, each of three tetrahedra that share diagonals with their neighbours.
    ordered = np.sort(triangles, axis=1)
    i, j, k = ordered.T
    up = len(side)
    tetrahedra = np.concatenate(
        [np.column_stack(t) for t in ((i, j, k, k + up), (i, j, j + up, k + up), (i, i + up, j + up, k + up))]
    )
    nodes = 1e-3 * np.concatenate(
        [np.column_stack([np.full(up, x), side[:, 0], -side[:, 1]]) for x in (0.0, HALF_WIDTH)]
    )

    def held(x: np.ndarray) -> np.ndarray:
        mask = np.zeros(x.shape, dtype=bool)
        mask[x[:, 0] < 1e-9, 0] = True
        mask[x[:, 2] > -1e-9] = True
        return mask

    model = MechanicalModel.from_mesh(
        nodes, tetrahedra, fixed=held, element="quadratic", young_modulus=MODULUS, poisson_ratio=POISSON
    )

    def place(y: float, s: float) -> list[float]:
        return [0.0, 1e-3 * y, -1e-3 * s]

    model.add_cable("cable", np.array([place(line[g], stations[g]) for g in guides]), np.array(place(line[0], 0.0)))
    model.add_effector("tip", np.array(place(0.5 * sum(tops[1]), LENGTH - 1.0)))
    return model


@dataclass(frozen=True)
class Judged:
    """A body: distance that its tip moves [m], smaller stiffness of the tip in the plane [N/m], effort [N]."""

    reach: float
    stiffness: float
    effort: float

    def costs(self, baseline: Judged) -> np.ndarray:
        """Return both objectives as costs relative to the baseline's, shape (2,)."""
        return np.array([baseline.reach / self.reach, baseline.stiffness / self.stiffness])


def judge(distance: np.ndarray) -> Judged:
    """Solve a body with the cable pulled.

    Raises:
        InfeasibleDesign: see `build`.
        ConvergenceError: if no equilibrium is found.
    """
    from softgym_envs.mechanics.solvers.statics import Statics

    model = build(distance)
    rest = model.constraints["e"][0].value(model.nodes)
    state = Statics(model).solve(np.array([PULL])).condensed
    W = state.W
    held = (W.ee - W.ea @ np.linalg.solve(W.aa, W.ae))[1:, 1:]
    # Half of the body has half of the stiffness.
    moved = float(np.linalg.norm((state.delta.e - rest)[1:]))
    return Judged(moved, 2.0 / float(np.linalg.eigvalsh(held)[-1]), 2.0 * float(state.lambda_.a[0]))


class Autoencoder:
    """A variational autoencoder of signed distances: two dense layers each way.

    Args:
        examples: signed distances, shape (n, y, s).
        seed: of the weights and of the order of the examples.
        epochs: number of times that all examples are seen.
    """

    def __init__(self, examples: np.ndarray, *, seed: int = 0, epochs: int = 100) -> None:
        import torch
        from torch import nn

        torch.manual_seed(seed)
        torch.set_num_threads(1)
        self.shape = examples.shape[1:]
        size = int(np.prod(self.shape))
        data = torch.tensor(np.clip(examples, -DEEPEST, DEEPEST).reshape(len(examples), -1) / DEEPEST).float()
        self.mean = data.mean(dim=0)
        self.encoder = nn.Sequential(nn.Linear(size, 128), nn.SiLU(), nn.Linear(128, 64), nn.SiLU())
        self.ends = nn.Linear(64, 2 * LATENT)
        self.decoder = nn.Sequential(
            nn.Linear(LATENT, 64), nn.SiLU(), nn.Linear(64, 128), nn.SiLU(), nn.Linear(128, size)
        )
        weights = [*self.encoder.parameters(), *self.ends.parameters(), *self.decoder.parameters()]
        rate, batch = 1e-3, 128
        adam = torch.optim.Adam(weights, lr=rate)
        plan = torch.optim.lr_scheduler.CosineAnnealingLR(adam, epochs)
        # The variance of the error, in place of a weight of the divergence that would have to be chosen.
        variance = 1.0
        for _ in range(epochs):
            total = 0.0
            for rows in torch.randperm(len(data)).split(batch):
                some = data[rows]
                mean, log_variance = self.ends(self.encoder(some - self.mean)).chunk(2, dim=1)
                latent = mean + torch.exp(0.5 * log_variance) * torch.randn_like(mean)
                error = ((self.decoder(latent) + self.mean - some) ** 2).sum(dim=1)
                divergence = 0.5 * (mean**2 + log_variance.exp() - log_variance - 1.0).sum(dim=1)
                loss = (0.5 * error / variance + divergence).mean()
                adam.zero_grad()
                loss.backward()
                adam.step()
                total += float(error.detach().sum())
            variance = total / (len(data) * size)
            plan.step()

    def encode(self, examples: np.ndarray) -> np.ndarray:
        """Return the latent places of signed distances (n, y, s), shape (n, LATENT)."""
        import torch

        data = torch.tensor(np.clip(examples, -DEEPEST, DEEPEST).reshape(len(examples), -1) / DEEPEST).float()
        with torch.no_grad():
            return self.ends(self.encoder(data - self.mean))[:, :LATENT].double().numpy()

    def decode(self, latent: np.ndarray) -> np.ndarray:
        """Return the signed distances at latent places (n, LATENT), shape (n, y, s) [mm]."""
        import torch

        with torch.no_grad():
            found = self.decoder(torch.tensor(np.atleast_2d(latent)).float()) + self.mean
        return DEEPEST * found.double().numpy().reshape(-1, *self.shape)


def examples(count: int, seed: int) -> np.ndarray:
    """Draw examples that mesh, shape (count, y, s)."""
    rng, found = np.random.default_rng(seed), []
    while len(found) < count:
        found.append(example(rng))
    return np.array(found)


def tried(model: Autoencoder, kept: Path, samples: int, seed: int = 5) -> list[str]:
    """Solve samples of the latent space; those in the file ``kept`` are not solved again.

    Returns:
        For each sample ``"solved"``, or the reason why it cannot be used.
    """
    found = kept.read_text().splitlines()[:samples] if kept.exists() else []
    latent = np.random.default_rng(seed).normal(size=(samples, LATENT))
    for distance in model.decode(latent[len(found) :]) if len(found) < samples else []:
        try:
            judge(distance)
            found.append("solved")
        except SoftGymError as error:
            found.append(str(error).splitlines()[0])
        with kept.open("a") as stream:
            stream.write(found[-1] + "\n")
    return found


def quality(model: Autoencoder, test: np.ndarray, samples: list[str]) -> dict[str, Any]:
    """Return errors of reconstruction on examples that were not learned, and the share of samples that can be used."""
    found = model.decode(model.encode(test))
    near = np.abs(test) < 3.0
    both, either = ((found < 0) & (test < 0)).sum(axis=(1, 2)), ((found < 0) | (test < 0)).sum(axis=(1, 2))
    return {
        "error near the surface [mm]": float(np.abs(found - test)[near].mean()),
        "overlap": float((both / either).mean()),
        "decoded samples": len(samples),
        "share that meshes and solves": samples.count("solved") / len(samples),
        "other samples": {text: samples.count(text) for text in sorted(set(samples) - {"solved"})},
    }


def measure(folder: Path) -> tuple[Autoencoder, dict[str, Any]]:
    """Train the autoencoder and return it and its `quality`."""
    folder.mkdir(parents=True, exist_ok=True)
    began = time.process_time()
    model = Autoencoder(examples(2000, 1))
    seconds = time.process_time() - began
    print(f"trained in {seconds:.0f} CPU s", file=sys.stderr)
    found = quality(model, examples(300, 2), tried(model, folder / "samples.txt", SAMPLES))
    print(json.dumps(found), file=sys.stderr, flush=True)
    return model, found | {"training [CPU s]": seconds, "commit": provenance()["commit"]}


def search(
    kept: Path, names: list[str], bounds: np.ndarray, shape: Callable[[np.ndarray], np.ndarray], seed: int, budget: int
) -> list[dict[str, Any]]:
    """Search for fingers with NSGA-II; bodies in the file ``kept`` are not solved again.

    Returns:
        The variables of each body, and its `Judged` values or the reason why there are none.
    """
    import optuna

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    sampler = optuna.samplers.NSGAIISampler(population_size=10, seed=seed)
    study = optuna.create_study(directions=["maximize", "maximize"], sampler=sampler)
    rows = [json.loads(line) for line in kept.read_text().splitlines()] if kept.exists() else []
    rows = rows[:budget]
    for k in range(budget):
        trial = study.ask()
        x = np.array([trial.suggest_float(n, low, high) for n, (low, high) in zip(names, bounds, strict=True)])
        if k == len(rows):
            row: dict[str, Any] = {"x": x.tolist()}
            began = time.process_time()
            try:
                row |= asdict(judge(shape(x)))
            except (InfeasibleDesign, ConvergenceError) as error:
                row["failed"] = str(error)
            row["seconds"] = time.process_time() - began
            rows.append(row)
            with kept.open("a") as stream:
                stream.write(json.dumps(row) + "\n")
        if "failed" in rows[k]:
            study.tell(trial, state=optuna.trial.TrialState.FAIL)
        else:
            study.tell(trial, [rows[k]["reach"], rows[k]["stiffness"]])
    return rows


def volume(rows: list[dict[str, Any]], baseline: Judged) -> float:
    """Return the hypervolume of bodies: costs relative to the baseline's, up to twice its costs."""
    from softgym_envs.codesign.benchmark.scoring import WORST, hypervolume

    solved = [Judged(row["reach"], row["stiffness"], row["effort"]) for row in rows if "failed" not in row]
    costs = np.array([body.costs(baseline) for body in solved]).reshape(-1, 2)
    return hypervolume(costs, np.full(2, WORST))


def run(folder: Path, budget: int) -> dict[str, Any]:
    """Train, search and compare; see the module."""
    model, measured = measure(folder)
    baseline = judge(seven_parameters(BASELINE))
    spaces: dict[str, tuple[list[str], np.ndarray, Callable[[np.ndarray], np.ndarray]]] = {
        "seven parameters": (list(PARAMETERS), np.array(list(PARAMETERS.values())), seven_parameters),
        "latent space": (
            [f"z{k}" for k in range(LATENT)],
            np.tile([-LATENT_BOUND, LATENT_BOUND], (LATENT, 1)),
            lambda x: model.decode(x)[0],
        ),
    }
    found: dict[str, Any] = {"baseline": asdict(baseline), "quality": measured}
    found |= {"budget": budget, "searches": []}
    for seed in SEEDS:
        for name, (names, bounds, shape) in spaces.items():
            kept = folder / f"{name.replace(' ', '_')}_{seed}.jsonl"
            rows = search(kept, names, bounds, shape, seed, budget)
            entry = {"space": name, "seed": seed, "hypervolume": volume(rows, baseline)}
            entry["failed"] = [number for number, row in enumerate(rows) if "failed" in row]
            print(entry, file=sys.stderr, flush=True)
            shapes = [row for row in rows if "failed" not in row]
            entry["bodies"] = [{k: row[k] for k in ("x", "reach", "stiffness", "effort")} for row in shapes]
            found["searches"].append(entry)
    return found


def _kept() -> dict[str, Any]:
    if not KEPT.is_file():
        raise DataError(
            f"'{KEPT}' does not exist; make it with 'python -m benchmarks.grown_shapes results/grown_shapes'"
        )
    return json.loads(KEPT.read_text())


def grown_shapes_table() -> str:
    """Hypervolumes of both spaces by seed and their means, and how much larger that of the latent space is."""
    found = _kept()
    spaces = ("seven parameters", "latent space")
    entries = [[e for e in found["searches"] if e["space"] == space] for space in spaces]
    volumes = np.array([[entry["hypervolume"] for entry in each] for each in entries])
    unused = [[f"{len(entry['failed'])} of {found['budget']}" for entry in each] + [""] for each in entries]
    rows = []
    names = [*(f"seed {entry['seed']}" for entry in entries[0]), "mean"]
    for k, (one, two) in enumerate(np.column_stack([volumes, volumes.mean(axis=1)]).T):
        gain = f"{100.0 * (two / one - 1.0):+.1f} %"
        rows.append([names[k], f"{one:.3f}", f"{two:.3f}", gain, unused[0][k], unused[1][k]])
    return markdown(["search", *spaces, "difference", *(f"{space}: not solved" for space in spaces)], rows, "lrrrrr")


def grown_leads_table() -> str:
    """How much larger the hypervolume of the latent space is after some of the bodies, by seed and of the means."""
    found = _kept()
    baseline = Judged(**found["baseline"])

    def after(space: str, bodies: int) -> np.ndarray:
        """Hypervolumes of the first bodies of each search; those that were not solved count as bodies."""
        entries = [entry for entry in found["searches"] if entry["space"] == space]
        solved = [bodies - sum(number < bodies for number in entry["failed"]) for entry in entries]
        return np.array([volume(entry["bodies"][:k], baseline) for entry, k in zip(entries, solved, strict=True)])

    rows = []
    for bodies in (60, 150, found["budget"]):
        one, two = after("seven parameters", bodies), after("latent space", bodies)
        leads = [*(two / one - 1.0), two.mean() / one.mean() - 1.0]
        rows.append([f"{bodies}", *(f"{100.0 * lead:+.1f} %" for lead in leads)])
    return markdown(["bodies", *(f"seed {seed}" for seed in SEEDS), "mean"], rows, "rrrrr")


def grown_quality_table() -> str:
    """What the autoencoder makes of examples that it has not seen, and of samples."""
    found = _kept()["quality"]
    rows = [
        ["error of the signed distance within 3 mm of the surface", f"{found['error near the surface [mm]']:.2f} mm"],
        ["common area of example and decoded example, over their union", f"{100.0 * found['overlap']:.0f} %"],
        [
            f"share of {found['decoded samples']} samples of the latent space that mesh and solve",
            f"{100.0 * found['share that meshes and solves']:.0f} %",
        ],
        ["training", f"{found['training [CPU s]']:.0f} CPU s"],
    ]
    return markdown(["quantity", "value"], rows, "lr")


def draw() -> np.ndarray:
    """Return a picture (h, w, 3): examples, what becomes of them, samples, and what both searches found."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    found, model = json.loads(KEPT.read_text()), Autoencoder(examples(2000, 1))
    baseline = Judged(**found["baseline"])
    shown = examples(300, 2)[:4]
    sampled = model.decode(np.random.default_rng(5).normal(size=(4, LATENT)))
    columns = {"example": shown, "decoded again": model.decode(model.encode(shown)), "sample": sampled}
    shapes = {"seven parameters": seven_parameters, "latent space": lambda x: model.decode(x)[0]}
    for name, shape in shapes.items():
        best = []
        for entry in found["searches"]:
            if entry["space"] == name:
                bodies = [body for body in entry["bodies"] if 2.0 * body["stiffness"] > baseline.stiffness]
                best.append(shape(np.array(max(bodies, key=lambda body: body["reach"])["x"])))
        columns[f"{name}:\nbest reach"] = np.array(best)
    figure = Figure(figsize=(11.0, 5.4), layout="constrained", dpi=110)
    canvas = FigureCanvasAgg(figure)
    above, below = figure.subfigures(2, 1, height_ratios=(1.0, 1.3))
    grid = above.subplots(4, len(columns))
    for column, (name, bodies) in enumerate(columns.items()):
        grid[0, column].set_title(name, fontsize=9)
        for row in range(4):
            grid[row, column].axis("off")
            if row < len(bodies):
                grid[row, column].contourf(ALONG, ACROSS, bodies[row], [-99.0, 0.0], colors=["#10776d"])
                grid[row, column].set_aspect("equal")
    for seed, axes in zip(SEEDS, below.subplots(1, len(SEEDS), sharey=True), strict=True):
        for name, colour in (("seven parameters", "tab:blue"), ("latent space", "tab:red")):
            bodies = next(e["bodies"] for e in found["searches"] if (e["space"], e["seed"]) == (name, seed))
            reach, stiffness = (np.array([body[key] for body in bodies]) for key in ("reach", "stiffness"))
            axes.plot(1e3 * reach, stiffness, ".", color=colour, label=name, markersize=4)
        axes.plot(1e3 * baseline.reach, baseline.stiffness, "k*", label="baseline")
        axes.set_yscale("log")
        axes.set_title(f"seed {seed}", fontsize=9)
        axes.set_xlabel("the tip moves [mm]", fontsize=8)
        axes.tick_params(labelsize=7, which="both")
    below.axes[0].set_ylabel("stiffness of the tip [N/m]", fontsize=8)
    below.axes[0].legend(fontsize=7)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


TABLES = {
    "grown_shapes": grown_shapes_table,
    "grown_leads": grown_leads_table,
    "grown_quality": grown_quality_table,
}
"""Tables of pages by name."""

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="what is finished, for a search that goes on")
    parser.add_argument("--bodies", type=int, default=300, help="of each search")
    parser.add_argument("--quality", action="store_true", help="measure the autoencoder only")
    given = parser.parse_args()
    if given.quality:
        write_json(KEPT, _kept() | {"quality": measure(given.folder)[1]})
    else:
        write_json(KEPT, {**run(given.folder, given.bodies), "provenance": provenance()})
