"""Online learning: a trained ensemble learns equilibria that the finite elements found where it could not be trusted.

Every member is trained a little more on the new states together with *rehearsal*: states that the member itself
predicts where the ensemble is trusted. It does not forget, and the data it was made from need not be at hand. Members
rehearse their own predictions, not those of the ensemble, and none sees all new states, so that they go on differing
where nothing is known.

When is a prediction trusted afterwards? Four things decide, and each errs to the safe side:

* The box of known displacements and designs grows to include the new states. A box has corners where no state is, so
  it only says that the model may be asked there at all.
* Where a robot can buckle, its actuators may become as soft as in the softest of the new states, but not as soft as in
  one that was no data because it is about to buckle.
* The spread of the ensemble decides inside the box, with the limit of the original weights: new states never make the
  model less demanding.
* Some of the new states are kept from all members. Where the ensemble errs there by more than its spread says, the
  factor from spread to uncertainty is raised until 95 % of these errors lie below; it is never lowered. Members that
  have come to agree on something wrong are found out so. Errors below a quarter of the limit need no excuse: few
  states are kept, and one with a tiny spread would otherwise raise the alarm everywhere.

Kept states come from the same episodes as the learned ones, so they vouch for what lies between them, not for what lies
far away; there it is the disagreement of the members that counts.
"""

from __future__ import annotations

import hashlib
import json
import time
import uuid
from collections.abc import Iterable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from softgym_envs.errors import DataError, WeightsError
from softgym_envs.robots.base import Robot
from softgym_envs.storage import atomic_write, read_npz, write_json
from softgym_envs.surrogate.data.dataset import COLUMNS
from softgym_envs.surrogate.data.states import GROWTH, States, stable_rows, training_states
from softgym_envs.surrogate.model import SurrogateModel
from softgym_envs.surrogate.potential.model import Model
from softgym_envs.surrogate.potential.training import make_targets, potential_loss, stack_members, unstack_members

#: Of the new states one in so many is kept from all members, to check them.
KEPT = 8

#: Entries of a card that are about the training of the original weights and no longer hold.
_OF_TRAINING = ("test", "best_validation", "training_seconds", "provenance")

_FORMAT = 1


def check_ensemble(model: SurrogateModel) -> Model:
    """Return the model if its ensemble can tell where it may be trusted.

    Raises:
        WeightsError: if it cannot: another kind of network, a single member, or no limit in its card.
    """
    if not isinstance(model, Model):
        raise WeightsError(f"online learning needs a network of kind 'potential'; these weights are '{model.network}'")
    if not model.robot.convex:
        raise WeightsError(f"online learning needs a convex energy; that of robot '{model.robot.name}' is not")
    if model.members < model.trained:
        raise WeightsError(
            "online learning needs all members of an ensemble of 2 or more: their spread decides what is trusted, and "
            f"is calibrated for all; got {model.members}"
        )
    if not {"displacement", "design", "limit", "inflation"} <= model.card.get("domain", {}).keys():
        raise WeightsError("the card of the weights does not say where they are trusted; train them with 'softgym fit'")
    return model


# -- states that are kept ------------------------------------------------------------------------------------------


class StateStore:
    """Equilibria collected over episodes, in memory and, where a folder is given, in atomic npz shards.

    Shards have the columns of a dataset and each begins with the rest state of its body, so that each can be read
    alone. Several processes may collect into one folder; each sees what the others wrote when it is started.

    Args:
        robot: whose states they are.
        folder: where they are kept, or None for memory alone. What it holds is read.

    Attributes:
        data: all states, columns of `softgym_envs.surrogate.data.dataset.COLUMNS`; shards one after the other.
        count: states in it, without rest states.

    Raises:
        DataError: if the folder holds states of another robot or its manifest cannot be read. A damaged shard is
            renamed to ``*.corrupt``, with a message.
    """

    def __init__(self, robot: Robot, folder: str | Path | None = None) -> None:
        self.robot = robot
        self.folder = None if folder is None else Path(folder)
        n = len(robot.actuators) + 3 * len(robot.effectors)
        sizes = (len(robot.design_space.names), len(robot.actuators), len(robot.actuators), 3 * len(robot.effectors))
        self._widths = dict(zip(COLUMNS, (*sizes, n * (n + 1) // 2), strict=False))
        self._parts: list[dict[str, np.ndarray]] = []
        if self.folder is None:
            return
        asked = json.loads(json.dumps({"format": _FORMAT, "robot": robot.name, "mechanics_key": robot.mechanics_key}))
        path = self.folder / "manifest.json"
        if path.exists():
            try:
                found = json.loads(path.read_text())
            except (OSError, ValueError) as error:
                raise DataError(f"manifest '{path}' cannot be read: {error}") from error
            if found != asked:
                raise DataError(f"'{self.folder}' holds states of another robot: {found}, asked {asked}")
        else:
            write_json(path, asked)
        for shard in sorted(self.folder.glob("states_*.npz")):
            try:
                self._parts.append(self._checked(read_npz(shard, COLUMNS), f"shard '{shard}'"))
            except DataError as error:
                aside = shard.with_suffix(".corrupt")
                shard.rename(aside)
                print(f"{error}; set aside as '{aside.name}'")

    def _checked(self, part: Mapping[str, np.ndarray], what: str) -> dict[str, np.ndarray]:
        rows = len(part["rest"])
        for name, width in self._widths.items():
            if part[name].shape != (rows, width) or not np.isfinite(part[name]).all():
                raise DataError(f"{what}: '{name}' must be {rows} rows of {width} finite numbers")
        if rows == 0 or not part["rest"][0]:
            raise DataError(f"{what} does not begin with a rest state")
        return {name: np.array(part[name]) for name in COLUMNS}

    @property
    def data(self) -> dict[str, np.ndarray]:
        return {name: np.concatenate([part[name] for part in self._parts]) for name in COLUMNS}

    @property
    def count(self) -> int:
        return sum(len(part["rest"]) - int(part["rest"].sum()) for part in self._parts)

    def add(self, part: Mapping[str, np.ndarray]) -> None:
        """Add states, beginning with the rest state of their body, and write their shard.

        Raises:
            DataError: if columns have a wrong shape, are not finite, or lack the rest state.
        """
        checked = self._checked(part, "new states")
        if self.folder is not None:
            # In the order of time, and unique: several stores and processes may collect into one folder.
            with atomic_write(self.folder / f"states_{time.time_ns():020d}_{uuid.uuid4().hex}.npz") as stream:
                np.savez(stream, allow_pickle=False, **checked)
        self._parts.append(checked)


# -- learning ------------------------------------------------------------------------------------------------------


def rehearsal_states(model: Model, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Draw bodies and displacements where a model is trusted: its domain, less what its ensemble disagrees about.

    Returns:
        Designs (count, len(space)) in the order of the space, the variable that only scales efforts at its baseline;
        and displacements (count, n_a). Where the ensemble trusts too little of its own domain to find so many, those
        of the smallest spread are taken.
    """
    rng = np.random.default_rng([seed, 0])
    space, domain = model.robot.design_space, model.card["domain"]
    candidates = 8 * count
    designs = np.tile([space.baseline[name] for name in space.names], (candidates, 1))
    for name, (low, high) in domain["design"].items():
        designs[:, space.names.index(name)] = rng.uniform(low, high, candidates)
    box = np.array(domain["displacement"])
    displacement = rng.uniform(box[:, 0], box[:, 1], (candidates, model.count))
    context = model.context(designs)
    spread = model.state(context, displacement)[2]
    _, trusted = model.trust(context, displacement, spread)
    # Trusted ones first, as they were drawn.
    chosen = np.argsort(np.where(trusted, 0.0, spread), kind="stable")[:count]
    return designs[chosen], displacement[chosen]


def _predicted(model: Model, designs: np.ndarray, displacement: np.ndarray) -> States:
    """What a model says, as states that it can be trained on."""
    context = model.context(designs)
    effort, effector, _ = model.state(context, displacement)
    return States(
        design=model.features.design(designs),
        actuation=model.features.actuation(displacement),
        displacement=displacement,
        effort=effort,
        effector=effector,
        W=model.compliance(context, displacement),
        rest_of=np.arange(len(effort)),
    )


def _joined(a: States, b: States) -> States:
    """Two sets of states, one after the other."""
    parts = {f.name: np.concatenate([getattr(a, f.name), getattr(b, f.name)]) for f in fields(States)}
    parts["rest_of"] = np.arange(len(a) + len(b))
    return States(**parts)


def fine_tune(
    model: Model,
    data: Mapping[str, np.ndarray],
    *,
    steps: int = 800,
    learning_rate: float = 3e-3,
    batch_size: int = 128,
    rehearsal: int = 1024,
    seed: int = 0,
) -> Model:
    """Return a model that also knows new states; the given one is not changed.

    Half of every batch is new, half rehearsed. The result depends on the model, the states and the seed alone.

    Args:
        model: an ensemble of potential networks whose card holds its domain.
        data: columns of equilibria, as `softgym_envs.surrogate.data.dataset.load_dataset` gives them; unstable ones are
            left out.
        steps: steps of Adam for each member.
        learning_rate: the largest, of a one-cycle schedule.
        batch_size: rows of a batch.
        rehearsal: states that each member rehearses.
        seed: of the rehearsed states and the batches.

    Raises:
        DataError: if no state can be learned, or the training diverges.
        WeightsError: if the model is no ensemble with a known domain.
    """
    import torch

    from softgym_envs.surrogate.potential.torch import PotentialNet

    check_ensemble(model)
    start = time.perf_counter()
    robot, M = model.robot, model.members
    new = training_states(robot, data, model.features)
    if len(new) == 0:
        raise DataError("none of the new states is stable: there is nothing to learn")
    states, scales = unstack_members(model.tensors)
    # Batches of states come in the order of episodes; neighbours go to different members.
    turn = np.random.default_rng([seed, 1]).permutation(len(new))
    kept = turn < (len(new) // KEPT if len(new) >= 2 * KEPT else 0)
    designs, displacement = rehearsal_states(model, rehearsal, seed)
    tuned = []
    for member in range(M):
        own = Model(robot, _member(model.tensors, member), {})
        seen = np.flatnonzero(~kept & ((turn % M != member) | (len(new) < 2 * M)))
        old = _predicted(own, designs, displacement)
        targets = make_targets(robot, _joined(new.rows(seen), old), scales)
        effort_spread = targets.effort_spread
        net = PotentialNet(
            model.count,
            model.effectors,
            new.design.shape[1],
            model.width,
            states[member]["body.0.weight"].shape[0],
            states[member].get("rest"),
        )
        net.load_state_dict({k: torch.tensor(v) for k, v in states[member].items()})
        generator = torch.Generator().manual_seed(seed + 1000 * member)
        optimiser = torch.optim.Adam(net.parameters(), lr=learning_rate, betas=(0.9, 0.99))
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimiser, learning_rate, total_steps=steps, pct_start=0.1, final_div_factor=1e3
        )
        half = batch_size // 2
        for _ in range(steps):
            rows = torch.cat(
                [
                    torch.randint(len(seen), (half,), generator=generator),
                    len(seen) + torch.randint(len(old), (batch_size - half,), generator=generator),
                ]
            )
            value = potential_loss(net, targets.rows(rows), effort_spread)
            optimiser.zero_grad()
            value.backward()
            torch.nn.utils.clip_grad_norm_(net.parameters(), 10.0)
            optimiser.step()
            schedule.step()
        if not np.isfinite(value.item()):
            raise DataError(f"online training of member {member} diverged: its loss is {value.item()}")
        tuned.append({k: v.detach().numpy().copy() for k, v in net.state_dict().items()})
    tensors = stack_members(tuned, scales)
    card = _widened(model, Model(robot, tensors, model.card), data, kept)
    digest = _digest(data, COLUMNS)
    card["data_sha256"] = hashlib.sha256(f"{model.card.get('data_sha256')}{digest}".encode()).hexdigest()
    card["online"] = {
        "parent_data_sha256": model.card.get("data_sha256"),
        "parent_weights_sha256": _digest(model.tensors, sorted(model.tensors)),
        "parent_domain": model.card["domain"],
        "states_sha256": digest,
        "rows": len(data["rest"]),
        "states": len(data["rest"]) - int(np.sum(data["rest"])),
        "unstable_states_left_out": len(data["rest"]) - len(new),
        "kept_states": int(kept.sum()),
        "steps": steps,
        "learning_rate": learning_rate,
        "batch_size": batch_size,
        "rehearsal": rehearsal,
        "seed": seed,
        "seconds": round(time.perf_counter() - start, 2),
    }
    return Model(robot, tensors, card)


def is_of(model: Model, parent: Model, data: Mapping[str, np.ndarray], steps: int, seed: int) -> bool:
    """Whether a model is `fine_tune` of ``parent`` on the first rows of some states, with these options."""
    online = model.card.get("online", {})
    rows = online.get("rows", 0)
    return bool(
        0 < rows <= len(data["rest"])
        and (online["steps"], online["seed"]) == (steps, seed)
        and online.get("parent_domain") == parent.card["domain"]
        and online["parent_weights_sha256"] == _digest(parent.tensors, sorted(parent.tensors))
        and online["states_sha256"] == _digest({k: v[:rows] for k, v in data.items()}, COLUMNS)
    )


def _digest(arrays: Mapping[str, np.ndarray], names: Iterable[str]) -> str:
    """SHA-256 of arrays, in the order of their names."""
    digest = hashlib.sha256()
    for name in names:
        digest.update(np.ascontiguousarray(arrays[name]).tobytes())
    return digest.hexdigest()


def _member(tensors: Mapping[str, np.ndarray], member: int) -> dict[str, np.ndarray]:
    """The weights of one member, as an ensemble of one."""
    return {k: v if k.startswith("scale.") or k == "rest" else v[member : member + 1] for k, v in tensors.items()}


def _widened(before: Model, after: Model, data: Mapping[str, np.ndarray], kept: np.ndarray) -> dict[str, Any]:
    """The card of a model after it learned states, of which ``kept`` (of the stable ones) no member saw."""
    robot, names = before.robot, before.robot.design_space.names
    stable = stable_rows(robot, data)
    left_out = {name: data[name][~stable] for name in ("design", "displacement")}
    data = {name: data[name][stable] for name in COLUMNS}
    card = {k: v for k, v in before.card.items() if k not in _OF_TRAINING}
    domain = json.loads(json.dumps(card["domain"]))
    for k, box in enumerate(domain["displacement"]):
        domain["displacement"][k] = _grown(box, data["displacement"][:, k])
    for name, box in domain["design"].items():
        domain["design"][name] = _grown(box, data["design"][:, names.index(name)])
    if "growth" in domain:
        learned, beyond = (after.growth(after.context(d["design"]), d["displacement"]) for d in (data, left_out))
        bound = min(GROWTH, float(beyond.min(initial=np.inf)))
        domain["growth"] = max(domain["growth"], min(float(learned.max()), bound))
    if kept.any():
        designs, displacement, truth = (data[k][kept] for k in ("design", "displacement", "effector"))
        _, effector, spread = after.state(after.context(designs), displacement)
        error = np.linalg.norm((effector - truth).reshape(len(truth), -1, 3), axis=2).max(axis=1)
        least = 0.25 * domain["limit"] / domain["inflation"]
        domain["inflation"] = max(domain["inflation"], float(np.quantile(error / np.maximum(spread, least), 0.95)))
    card["domain"] = domain
    return card


def _grown(box: list[float], values: np.ndarray) -> list[float]:
    return [min(box[0], float(values.min())), max(box[1], float(values.max()))]
