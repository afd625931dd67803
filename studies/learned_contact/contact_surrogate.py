"""The learned chain of the contact-aided finger against finite elements, with contacts that it has not seen.

``python -m benchmarks.contact_surrogate`` prints one JSON object. Bodies are drawn from the box of the training,
obstacles are round bars in front of the zigzag leg, and friction differs from scene to scene. The chain was trained
without any contact.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click
import numpy as np

from softgym_envs.mechanics.contact.contact import ContactSettings

if TYPE_CHECKING:
    from softgym_envs.mechanics.contact.obstacles import Cylinder
    from softgym_envs.surrogate.chain.contact import ChainBatch
    from softgym_envs.surrogate.chain.model import ChainModel

INCREMENTS = 12
MAX_DRAWS = 3000
"""Scenes that are drawn before giving up on one."""
GAPS = (1.0e-4, 2.5e-4)
"""Distance of a further bar from the bent finger [m]: half of the distance of contact and less."""
BLOCK, STATES = 1000, 50
"""Bodies of a batch, and states of each body, in which W is checked."""


@dataclass(frozen=True)
class Scene:
    """A body that closes on round bars.

    Attributes:
        design: values in the order of the design space.
        bars: the obstacles.
        angle: of the servo at the end [rad].
    """

    design: np.ndarray
    bars: tuple[Cylinder, ...]
    angle: float


class Closing(NamedTuple):
    """States while a finger closes on k bars.

    Attributes:
        force: of the bars on the finger [N], shape (INCREMENTS, k, 2).
        tip: [m], shape (INCREMENTS, 2).
        torque: [N m], shape (INCREMENTS,).
        seconds: of the CPU.
    """

    force: np.ndarray
    tip: np.ndarray
    torque: np.ndarray
    seconds: float


def draw_scene(model: ChainModel, contacts: int, rng: np.random.Generator) -> Scene:
    """Draw a body and bars, all of which the closed chain presses.

    Bars stand before outer corners of the zigzag. The force on each is at least 1 % of the sum, which is at least
    0.1 N. Half of the bodies have zigzags that are moved towards a straight line. The first bar bends the finger, and
    the others are placed together before the bent finger. Scenes with more than four bars are rare.

    Raises:
        RuntimeError: if no scene is found in which the body at rest is free.
    """
    from softgym_envs.surrogate.chain.contact import ChainBatch

    corners = slice(1, 2 + model.chain.points)
    for _ in range(MAX_DRAWS):
        row = _draw_body(model, rng)
        if row is None:
            continue
        angle = float(np.radians(rng.uniform(15.0, 35.0)))
        friction = float(rng.uniform(0.0, 0.85))
        prepared = model.prepare(row)
        if not prepared.known[0]:
            continue
        chosen = np.sort(rng.permutation(model.chain.points + 1)[:contacts])
        bars: list[Cylinder] = []
        for group in (chosen[:1], chosen[1:]):
            batch = _closed(model, row, bars, angle)
            if batch is None:
                break
            bars += _bars_before(batch, corners, group, friction, rng, len(bars))
        if len(bars) < contacts or ChainBatch(prepared, [bars]).states.gap[0] < 0.001:
            continue
        if _all_press(_closed(model, row, bars, angle)):
            return Scene(row[0], tuple(bars), angle)
    raise RuntimeError(f"no scene with {contacts} contacts was found")


def _draw_body(model: ChainModel, rng: np.random.Generator) -> np.ndarray | None:
    """Return a body (1, len(space)) from the box of the training, or None if its outline crosses itself."""
    from softgym_envs.errors import InfeasibleDesign

    robot = model.robot
    values = {name: rng.uniform(*box) for name, box in model.card["domain"]["design"].items()}
    part = rng.choice([1.0, rng.uniform()])
    for k in range(1, model.chain.points):
        values[f"d{k}"] = values["d0"] + part * (values[f"d{k}"] - values["d0"])
    design = robot.design_space.complete(values)
    try:
        robot.outline(design)  # type: ignore[attr-defined]
    except InfeasibleDesign:
        return None
    return design.array[None]


def _bars_before(
    batch: ChainBatch,
    corners: slice,
    group: np.ndarray,
    friction: float,
    rng: np.random.Generator,
    placed: int,
) -> list[Cylinder]:
    """Return bars before the corners ``group`` of a bent finger; the first bar of a scene stands in the way."""
    from softgym_envs.mechanics.contact.obstacles import Cylinder
    from softgym_envs.surrogate.chain.model import carried_points

    prepared, chain = batch.prepared, batch.prepared.chain
    arms = (prepared.bodies.markers - prepared.bodies.nodes[:, chain.marker_nodes])[:, corners]
    places = carried_points(batch.memory.q, chain.marker_nodes[corners], arms)[0]
    bars: list[Cylinder] = []
    for k in group:
        gap = rng.uniform(*GAPS) if placed else -rng.uniform(0.001, 0.004)
        radius = float(rng.uniform(0.002, 0.0025))
        centre = (float(places[k, 0] + radius + gap), float(places[k, 1]), 0.0)
        name = f"bar {placed + len(bars) + 1}"
        bars.append(Cylinder(centre, (0.0, 0.0, 1.0), radius, friction=friction, name=name))
    return bars


def _all_press(batch: ChainBatch | None) -> bool:
    """Whether a chain has closed without touching itself, and presses every bar."""
    if batch is None or batch.states.folded[0]:
        return False
    pressing = batch.touching().pressing[0].sum(axis=1)
    return bool((pressing > 0.01 * pressing.sum()).all() and pressing.sum() > 0.1)


def _closed(model: ChainModel, row: np.ndarray, bars: Sequence[Cylinder], angle: float) -> ChainBatch | None:
    """Return the chain of one body after closing on bars; None if it does not close."""
    from softgym_envs.surrogate.chain.contact import ChainBatch

    batch = ChainBatch(model.prepare(row), [bars])
    for part in range(1, INCREMENTS + 1):
        if not batch.close(np.array([angle * part / INCREMENTS])).found[0]:
            return None
    return batch


def close_chain(model: ChainModel, scene: Scene) -> Closing | None:
    """Return what the chain predicts; None if an equilibrium is not found."""
    from softgym_envs.surrogate.chain.contact import ChainBatch

    batch = ChainBatch(model.prepare(scene.design[None]), [scene.bars])
    rows = []
    start = time.process_time()
    for part in range(1, INCREMENTS + 1):
        states = batch.close(np.array([scene.angle * part / INCREMENTS]))
        if not states.found[0]:
            return None
        rows.append((states.force[0].copy(), states.tip[0].copy(), float(states.torque[0])))
    force, tip, torque = (np.array(column) for column in zip(*rows, strict=True))
    return Closing(force, tip, torque, time.process_time() - start)


def close_fem(model: ChainModel, scene: Scene, self_contact: bool) -> Closing:
    """Return what finite elements compute.

    Raises:
        ConvergenceError: if finite elements find no equilibrium.
    """
    from softgym_envs.mechanics.solvers.statics import Statics

    body = model.robot.build(dict(zip(model.robot.design_space.names, map(float, scene.design), strict=True)))
    body.set_contact(obstacles=scene.bars, settings=ContactSettings(self_contact=self_contact))
    statics = Statics(body)
    rows = []
    start = time.process_time()
    for part in range(1, INCREMENTS + 1):
        state = statics.solve([scene.angle * part / INCREMENTS])
        assert state.contacts is not None
        rows.append((state.contacts.total[:, :2], state.condensed.delta.e[:2], float(state.effort[0])))
    force, tip, torque = (np.array(column) for column in zip(*rows, strict=True))
    return Closing(force, tip, torque, time.process_time() - start)


def accuracy(model: ChainModel, counts: Sequence[int], scenes: int, seed: int, self_contact: bool) -> dict[str, Any]:
    """Errors of contact force and tip for scenes with each number of bars."""
    from softgym_envs.errors import ConvergenceError, MeshingError

    rows = []
    for contacts in counts:
        for number in range(scenes):
            rng = np.random.default_rng([seed, contacts, number])
            row: dict[str, Any] = {"contacts": contacts, "scene": number}
            scene = draw_scene(model, contacts, rng)
            chain = close_chain(model, scene)
            try:
                fem = close_fem(model, scene, self_contact)
            except (ConvergenceError, MeshingError) as error:
                print(f"{contacts} contacts, scene {number}: finite elements fail: {error}", file=sys.stderr)
                rows.append(row | {"fem": False})
                continue
            row |= {"fem": True, "found": chain is not None, "fem_seconds": fem.seconds}
            row |= final_errors(chain, fem) if chain is not None else {}
            print(json.dumps(row), file=sys.stderr, flush=True)
            rows.append(row)
    good = [row for row in rows if row.get("found")]
    return {
        "rows": rows,
        "summary": _summary(good),
        "by_count": {str(k): _summary([r for r in good if r["contacts"] == k]) for k in counts},
    }


def final_errors(found: Closing, true: Closing) -> dict[str, float]:
    """Errors of a model at the last angle."""
    force, true_force = found.force[-1], true.force[-1]
    total, size = float(np.linalg.norm(true_force.sum(axis=0))), float(np.abs(true_force[:, 0]).sum())
    return {
        "pressed": int((np.linalg.norm(true_force, axis=1) > 1e-3 * max(size, 1e-9)).sum()),
        "force": total,
        "force_error": float(np.linalg.norm((force - true_force).sum(axis=0)) / total),
        "share_error": float(np.linalg.norm(force - true_force, axis=1).max() / total),
        "tip_error": float(np.linalg.norm(found.tip[-1] - true.tip[-1])),
        "torque_error": abs(found.torque[-1] / true.torque[-1] - 1.0),
    }


def _summary(rows: list[dict[str, Any]]) -> dict[str, float]:
    found: dict[str, float] = {"scenes": len(rows)}
    for name in ("force_error", "share_error", "tip_error", "torque_error"):
        values = np.array([row[name] for row in rows])
        if len(values):
            found |= {f"{name}_median": float(np.median(values)), f"{name}_worst": float(values.max())}
    return found


def definiteness(model: ChainModel, draws: int, seed: int) -> dict[str, float]:
    """Smallest eigenvalue of W in random states without friction, relative to the largest one of the same W.

    Each of the bodies from the box of the training closes on a wall at a random distance, through `STATES` angles.
    """
    from softgym_envs.mechanics.contact.obstacles import Plane
    from softgym_envs.surrogate.chain.contact import ChainBatch

    rng = np.random.default_rng(seed)
    space, box = model.robot.design_space, model.card["domain"]["design"]
    base = space.baseline.array
    low, high = (np.array([box.get(n, [b, b])[k] for n, b in zip(space.names, base, strict=True)]) for k in range(2))
    total = missing = unstable = pressed = 0
    smallest, seconds = np.inf, time.process_time()
    while total < draws:
        designs = rng.uniform(low, high, (BLOCK, len(low)))
        walls = [[Plane((x, 0.0, 0.0), (-1.0, 0.0, 0.0))] for x in rng.uniform(0.045, 0.075, BLOCK)]
        batch = ChainBatch(model.prepare(designs), walls)
        angles = np.sort(rng.uniform(0.0, model.robot.upper[0], (STATES, BLOCK)), axis=0)
        for row in angles:
            batch.move(row)
            W, stable = batch.compliance()
            found = batch.found
            eigenvalues = np.linalg.eigvalsh(0.5 * (W + W.mT)[found & stable])
            smallest = min(smallest, float((eigenvalues[:, 0] / eigenvalues[:, -1]).min()))
            total += BLOCK
            missing += int((~found).sum())
            unstable += int((found & ~stable).sum())
            pressed += int((found & (batch.touching().pressing > 0.0).any(axis=(1, 2))).sum())
    return {
        "draws": total,
        "not_found": missing,
        "unstable": unstable,
        "pressed": pressed,
        "smallest_eigenvalue_ratio": smallest,
        "cpu_seconds": time.process_time() - seconds,
    }


def speed(model: ChainModel, sizes: Sequence[int], seed: int) -> dict[str, float]:
    """Steps of 2 degrees per CPU second, of bodies that close on walls, for each size of batch."""
    from softgym_envs.mechanics.contact.obstacles import Plane
    from softgym_envs.surrogate.chain.contact import ChainBatch

    rng = np.random.default_rng(seed)
    space, box = model.robot.design_space, model.card["domain"]["design"]
    results = {}
    for size in sizes:
        for friction in (0.0, 0.5):
            designs = np.array(
                [space.complete({n: rng.uniform(*b) for n, b in box.items()}).array for _ in range(size)]
            )
            places = rng.uniform(0.045, 0.065, size)
            walls = [[Plane((x, 0.0, 0.0), (-1.0, 0.0, 0.0), friction=friction)] for x in places]
            batch = ChainBatch(model.prepare(designs), walls)
            batch.move(np.full(size, 1e-3))  # compiles
            repeats = max(1, 500 // size)
            seconds = 0.0
            for _ in range(repeats):
                batch.reset()
                start = time.process_time()
                for k in range(1, 16):
                    batch.move(np.full(size, np.radians(2.0 * k)))
                seconds += time.process_time() - start
            results[f"batch {size}, friction {friction}"] = 15 * size * repeats / seconds
    return results


@click.command()
@click.option("--weights", type=click.Path(path_type=Path), help="Folder of the weights (default: the shipped ones).")
@click.option("--contacts", default="1-4", show_default=True, help="Numbers of contacts, such as 1-4 or 1,3.")
@click.option("--scenes", default=3, show_default=True, help="Scenes for each number of contacts.")
@click.option("--seed", default=0, show_default=True)
@click.option("--self-contact", is_flag=True, help="Let the finite elements touch themselves, which chains do not.")
@click.option("--draws", default=0, show_default=True, help="Random states in which W is checked, instead of scenes.")
@click.option("--speed", "speeds", is_flag=True, help="Measure steps per CPU second, instead of scenes.")
def main(
    weights: Path | None, contacts: str, scenes: int, seed: int, self_contact: bool, draws: int, speeds: bool
) -> None:
    """Compare the learned chain with finite elements, or check its W, or measure its speed."""
    from softgym_envs.robots.registry import make_robot
    from softgym_envs.surrogate.chain.model import load_chain

    model = load_chain(make_robot("contact_aided_finger"), weights)
    if draws:
        print(json.dumps(definiteness(model, draws, seed), indent=1))
        return
    if speeds:
        print(json.dumps(speed(model, (1, 100, 1000), seed), indent=1))
        return
    if "-" in contacts:
        low, high = map(int, contacts.split("-"))
        counts = list(range(low, high + 1))
    else:
        counts = [int(part) for part in contacts.split(",")]
    print(json.dumps(accuracy(model, counts, scenes, seed, self_contact), indent=1))


if __name__ == "__main__":
    main()
