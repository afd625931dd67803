"""A set network over contacts beside the chain of segments, on finite elements with unseen numbers of contacts.

``python -m benchmarks.contact_sets FOLDER`` prints one JSON object. Bodies, bars and friction are those of
`benchmarks.contact_surrogate`. The network learns closings with one and two bars and is tested on others with one to
four; the chain learned no contact at all. Closings are kept in the folder.

The network (Zaheer et al., Deep sets, 2017) sees the body, the angle of the servo, and for each bar its place, radius,
friction, and gap and normal at rest. One layer encodes each bar, the codes are added up, and from the sum, the body and
the code of a bar follow the tip and the force of that bar. So the order of bars does not matter, and their number is
free. It learns twice: from finite elements, and from many closings of the chain, which cost little.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click
import numpy as np

from benchmarks.contact_surrogate import INCREMENTS, Closing, Scene, close_chain, close_fem, draw_scene, final_errors
from benchmarks.recorded import results
from benchmarks.tables import markdown
from softgym_envs.storage import atomic_write

if TYPE_CHECKING:
    import torch

    from softgym_envs.surrogate.chain.model import ChainModel

LEARNED, TESTED = (1, 2), (1, 2, 3, 4)
"""Numbers of bars."""
MOST = max(TESTED)
FEATURES = 7
"""Of a bar: x, y, radius, friction, gap, and the two components of the normal."""
SCALES = np.array([0.05, 0.05, 0.002, 0.5, 0.01, 1.0, 1.0])
TIP_SCALE, FORCE_SCALE, SMALL_FORCE = 1e-3, 0.5, 0.1
"""Of errors of the tip [m]; of forces [N]; and the force below which errors are absolute [N]."""
WIDTH, STEPS, BATCH, RATE = 64, 4000, 256, 2e-3
TEST_SEED, TRAIN_SEED, CHAIN_SEED = 1, 2, 3


class Kept(NamedTuple):
    """A scene and how fingers close on it.

    Attributes:
        design: values in the order of the design space.
        bars: x, y, radius [m] and friction of each, shape (k, 4).
        angle: of the servo at the end [rad].
        fem: by finite elements, or by the chain for closings that only teach.
        chain: by the chain; None if it does not close.
    """

    design: np.ndarray
    bars: np.ndarray
    angle: float
    fem: Closing
    chain: Closing | None


@dataclass(frozen=True)
class Samples:
    """States that a set network learns from or predicts, rows in the order of scenes and angles.

    Attributes:
        body: body and angle, in [-1, 1], shape (n, g).
        bars: features, shape (n, MOST, FEATURES).
        there: whether there is such a bar, shape (n, MOST).
        force: of the bars [N], shape (n, MOST, 2).
        tip: displacement from rest [m], shape (n, 2).
    """

    body: np.ndarray
    bars: np.ndarray
    there: np.ndarray
    force: np.ndarray
    tip: np.ndarray


def bar_features(corners: np.ndarray, bars: np.ndarray) -> np.ndarray:
    """Return the features of bars (k, 4) before the outer side of a zigzag at rest, shape (k, FEATURES).

    Args:
        corners: of the zigzag [m], shape (c, 2).
        bars: x, y, radius and friction.
    """
    start, side = corners[:-1], np.diff(corners, axis=0)
    away = bars[:, None, :2] - start
    share = np.clip((away * side).sum(axis=2) / (side**2).sum(axis=1), 0.0, 1.0)
    lines = away - share[..., None] * side
    distance = np.linalg.norm(lines, axis=2)
    nearest = distance.argmin(axis=1)
    rows = np.arange(len(bars))
    length = distance[rows, nearest]
    normal = lines[rows, nearest] / length[:, None]
    return np.column_stack([bars, length - bars[:, 2], normal]) / SCALES


def samples(model: ChainModel, scenes: list[Kept]) -> Samples:
    """Return all states of scenes."""
    box = model.card["domain"]["design"]
    names = model.robot.design_space.names
    varied = [name for name in names if name in box and box[name][0] < box[name][1]]
    low, high = (np.array([box[name][k] for name in varied]) for k in range(2))
    columns = [names.index(name) for name in varied]
    parts: dict[str, list[np.ndarray]] = {name: [] for name in Samples.__annotations__}
    for scene in scenes:
        corners = model.prepare(scene.design[None]).bodies.markers[0][1 : 2 + model.chain.points]
        count = len(scene.bars)
        angles = scene.angle * np.arange(1, INCREMENTS + 1) / INCREMENTS / model.robot.upper[0]
        body = 2.0 * (scene.design[columns] - low) / (high - low) - 1.0
        padded = np.zeros((MOST, FEATURES))
        padded[:count] = bar_features(corners, scene.bars)
        force = np.zeros((INCREMENTS, MOST, 2))
        force[:, :count] = scene.fem.force
        parts["body"].append(np.column_stack([np.tile(body, (INCREMENTS, 1)), 2.0 * angles - 1.0]))
        parts["bars"].append(np.tile(padded, (INCREMENTS, 1, 1)))
        parts["there"].append(np.tile(np.arange(MOST) < count, (INCREMENTS, 1)))
        parts["force"].append(force)
        parts["tip"].append(scene.fem.tip - model.robot.effector_rest[:2])
    return Samples(**{name: np.concatenate(values) for name, values in parts.items()})


class SetNetwork:
    """Three small networks: code of a bar, tip, and force of a bar.

    Args:
        inputs: number of values of body and angle.
        seed: of the weights and of the batches.
    """

    def __init__(self, inputs: int, seed: int) -> None:
        import torch

        self._generator = torch.Generator().manual_seed(seed)
        torch.manual_seed(seed)
        nn = torch.nn
        sizes = ((inputs + FEATURES, WIDTH), (inputs + WIDTH, 2), (inputs + 2 * WIDTH, 2))
        self.code, self.tip, self.force = (
            nn.Sequential(
                nn.Linear(n, WIDTH), nn.SiLU(), nn.Linear(WIDTH, WIDTH), nn.SiLU(), nn.Linear(WIDTH, m)
            ).double()
            for n, m in sizes
        )

    @property
    def parameters(self) -> list[torch.Tensor]:
        """All weights."""
        return [w for part in (self.code, self.tip, self.force) for w in part.parameters()]

    def __call__(
        self, body: torch.Tensor, bars: torch.Tensor, there: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the forces [N] (n, k, 2) and tips [m] (n, 2) of states with k bars, see `Samples`."""
        import torch

        k = bars.shape[1]
        wide = body[:, None].expand(-1, k, -1)
        mask = there[..., None].to(body.dtype)
        codes = self.code(torch.cat([wide, bars], dim=2)) * mask
        total = codes.sum(dim=1)
        tip = 0.02 * self.tip(torch.cat([body, total], dim=1))
        force = self.force(torch.cat([wide, codes, total[:, None].expand(-1, k, -1)], dim=2))
        return FORCE_SCALE * force * mask, tip

    def learn(self, data: Samples, steps: int = STEPS) -> float:
        """Learn states by Adam; return the loss at the end.

        The loss has the errors of the tip, and those of each force and of their sum, relative to the sum.
        """
        import torch

        tensors = [torch.tensor(column) for column in (data.body, data.bars, data.there, data.force, data.tip)]
        optimiser = torch.optim.Adam(self.parameters, RATE)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
        loss = torch.zeros(())
        for _ in range(steps):
            rows = torch.randint(len(data.body), (BATCH,), generator=self._generator)
            body, bars, there, true_force, true_tip = (column[rows] for column in tensors)
            force, tip = self(body, bars, there)
            error, size = force - true_force, torch.linalg.norm(true_force.sum(dim=1), dim=1) + SMALL_FORCE
            relative = torch.cat([error, error.sum(dim=1, keepdim=True)], dim=1) / size[:, None, None]
            misses = (tip - true_tip) / TIP_SCALE
            loss = torch.nn.functional.huber_loss(relative, torch.zeros_like(relative), delta=0.1) * 10.0
            loss = loss + torch.nn.functional.huber_loss(misses, torch.zeros_like(misses))
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
        return float(loss.detach())

    def closings(self, model: ChainModel, scenes: list[Kept]) -> list[Closing]:
        """Predict how scenes close; the torque is not predicted."""
        import torch

        data = samples(model, scenes)
        with torch.no_grad():
            force, tip = self(*(torch.tensor(column) for column in (data.body, data.bars, data.there)))
        none = np.full(INCREMENTS, np.nan)
        rest = model.robot.effector_rest[:2]
        found = []
        for k, scene in enumerate(scenes):
            own = slice(k * INCREMENTS, (k + 1) * INCREMENTS)
            found.append(Closing(force[own, : len(scene.bars)].numpy(), tip[own].numpy() + rest, none, 0.0))
        return found


def make_scene(model: ChainModel, contacts: int, number: int, seed: int, teacher: str) -> Kept | None:
    """Draw a scene and close it by ``"fem"`` and the chain, or by the ``"chain"`` alone; None if something fails."""
    from softgym_envs.errors import ConvergenceError, MeshingError

    scene: Scene = draw_scene(model, contacts, np.random.default_rng([seed, contacts, number]))
    bars = np.array([[*bar.point[:2], bar.radius, bar.friction] for bar in scene.bars])
    chain = close_chain(model, scene)
    if teacher == "chain":
        return None if chain is None else Kept(scene.design, bars, scene.angle, chain, chain)
    try:
        return Kept(scene.design, bars, scene.angle, close_fem(model, scene, self_contact=False), chain)
    except (ConvergenceError, MeshingError) as error:
        print(f"{contacts} bars, scene {number}: finite elements fail: {error}", file=sys.stderr)
        return None


def kept_scenes(
    model: ChainModel, folder: Path, counts: tuple[int, ...], scenes: int, seed: int, teacher: str = "fem"
) -> list[Kept]:
    """Return scenes with each number of bars, from a folder if they are there; failed ones are left out."""
    found = []
    for contacts in counts:
        for number in range(scenes):
            path = folder / f"{teacher}_{seed}_{contacts}_{number}.npz"
            if not path.is_file():
                scene = make_scene(model, contacts, number, seed, teacher)
                with atomic_write(path) as stream:
                    np.savez_compressed(stream, allow_pickle=False, **({} if scene is None else _arrays(scene)))
            with np.load(path) as file:
                if file.files:
                    found.append(_scene(dict(file)))
    return found


def _arrays(scene: Kept) -> dict[str, Any]:
    columns: dict[str, Any] = {"design": scene.design, "bars": scene.bars, "angle": scene.angle}
    for name in ("fem", "chain"):
        closing = getattr(scene, name)
        if closing is not None:
            columns |= {f"{name} {key}": value for key, value in closing._asdict().items()}
    return columns


def _scene(file: dict[str, np.ndarray]) -> Kept:
    def closing(name: str) -> Closing | None:
        if f"{name} force" not in file:
            return None
        force, tip, torque, seconds = (file[f"{name} {key}"] for key in Closing._fields)
        return Closing(force, tip, torque, float(seconds))

    fem = closing("fem")
    assert fem is not None
    return Kept(file["design"], file["bars"], float(file["angle"]), fem, closing("chain"))


def errors_of(predictions: list[Closing | None], scenes: list[Kept]) -> dict[str, float]:
    """Median and worst errors of force [1] and tip [m] at the last angle."""
    rows = [final_errors(p, scene.fem) for p, scene in zip(predictions, scenes, strict=True) if p is not None]
    found: dict[str, float] = {"scenes": len(rows)}
    for key in ("force_error", "tip_error"):
        values = [row[key] for row in rows]
        found |= {f"{key}, median": float(np.median(values)), f"{key}, worst": float(np.max(values))}
    return found


def compare(
    model: ChainModel, folder: Path, taught: int, chain_taught: int, tests: int, steps: int = STEPS
) -> dict[str, Any]:
    """Return the errors of chain and set networks by the number of bars, and what they learned from."""
    test = {k: kept_scenes(model, folder, (k,), tests, TEST_SEED) for k in TESTED}
    learned = {
        "finite elements": kept_scenes(model, folder, LEARNED, taught, TRAIN_SEED),
        "the chain": kept_scenes(model, folder, LEARNED, chain_taught, CHAIN_SEED, "chain"),
    }
    found: dict[str, Any] = {}
    for k, scenes in test.items():
        found[f"chain, {k} bars"] = errors_of([scene.chain for scene in scenes], scenes)
    for teacher, scenes in learned.items():
        start = time.process_time()
        data = samples(model, scenes)
        network = SetNetwork(data.body.shape[1], seed=0)
        found[f"loss of the set network taught by {teacher}"] = network.learn(data, steps)
        found[f"states of {teacher}"] = len(data.body)
        found[f"CPU seconds of {teacher}: states, training"] = [
            sum(float(scene.fem.seconds) for scene in scenes),
            time.process_time() - start,
        ]
        found[f"taught by {teacher}, its own scenes"] = errors_of(list(network.closings(model, scenes)), scenes)
        for k, tested in test.items():
            found[f"taught by {teacher}, {k} bars"] = errors_of(list(network.closings(model, tested)), tested)
    return found


def contact_sets_table() -> str:
    """Median and worst error of force and tip, by the number of bars."""
    found = results("contact_sets")
    models = {"chain of segments": "chain"}
    for teacher in ("finite elements", "the chain"):
        states = f"{found[f'states of {teacher}']:,}"
        models[f"set network, {states} states of {teacher}"] = f"taught by {teacher}"
    rows = []
    for title, key in models.items():
        for column, factor, unit in (("force_error", 100.0, "force [%]"), ("tip_error", 1e3, "tip [mm]")):
            cells = []
            for k in TESTED:
                row = found[f"{key}, {k} bars"]
                middle, worst = (factor * row[f"{column}, {name}"] for name in ("median", "worst"))
                cells.append(f"{middle:.2g}, {worst:.2g}" if worst < 100.0 else f"{middle:.0f}, {worst:.0f}")
            rows.append([title if column == "force_error" else "", unit, *cells])
    return markdown(["model", "error: median, worst", *(f"{k} bar{'s'[: k > 1]}" for k in TESTED)], rows, "llrrrr")


TABLES = {"contact_sets": contact_sets_table}
"""Tables of pages by name."""


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--scenes", default=20, show_default=True, help="Scenes of finite elements to learn, for each number.")
@click.option("--chain-scenes", default=100, show_default=True, help="Scenes of the chain to learn, for each number.")
@click.option("--tests", default=4, show_default=True, help="Scenes of the test, for each number of bars.")
def main(folder: Path, scenes: int, chain_scenes: int, tests: int) -> None:
    """Compare set networks with the chain on finite elements."""
    from softgym_envs.robots.registry import make_robot
    from softgym_envs.surrogate.chain.model import load_chain

    model = load_chain(make_robot("contact_aided_finger"))
    print(json.dumps(compare(model, folder, scenes, chain_scenes, tests), indent=1))


if __name__ == "__main__":
    main()
