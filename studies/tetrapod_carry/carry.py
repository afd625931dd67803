"""How far to the right the Tetrapod moves with controllers, an optimised swing and learned policies.

``softgym bench carry`` compares them on every mesh. ``python -m benchmarks.carry PAYLOAD GENERATIONS SEED MESH``
searches for the swing: servo angles through a few knots, optimised by CMA-ES on batched finite elements so that the
centre gets as far as possible. It shows what is possible at all on that mesh, by default the published one, whose legs
fold. The search begins at the best of one generation of random swings, and what it finds is kept if it gets farther
than the stored swing. ``python -m benchmarks.carry imitate PAYLOAD FILE`` trains a small policy to imitate the swing of
the published mesh, from which evolution can begin.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

DATA = Path(__file__).parent / "data" / "tetrapod_swing.json"
POLICIES = {
    "SAC, trained with 1 kg": "tetrapod_carry",
    "evolution, trained with 1 kg": "tetrapod_carry_evolution",
    "evolution, trained with 0 kg": "tetrapod_carry_empty",
}
"""Shipped policies, by learner and payload."""
PAYLOADS = (0.0, 1.0)
SEARCHED = ("published", "accurate")
"""Meshes that have a stored swing."""
CONFIG = Path(__file__).parents[1] / "configs" / "agents" / "tetrapod_carry_empty.yaml"
"""Evolution that begins at an imitated swing."""

KNOTS = 8
STEPS = 100


def make(payload: float, mesh: str) -> gymnasium.Env:
    import softgym_envs  # noqa: F401 - registers the IDs

    return gymnasium.make("SoftGym/TetrapodCarry-v0", robot_options={"payload": payload, "mesh": mesh})


def episode(env: gymnasium.Env, act) -> tuple[float, float, float, int]:
    """Return the farthest and the last position to the right [mm], the return, and the folded steps of one episode."""
    observation, _ = env.reset(seed=0)
    reached, total, folded, ended = [], 0.0, 0, False
    while not ended:
        observation, reward, terminated, truncated, info = env.step(act(observation, env.unwrapped))
        reached.append(1e3 * info["effector"][0])
        total, ended = total + float(reward), terminated or truncated
        folded += not info["trusted"]
    return max(reached), reached[-1], total, folded


def swing_commands(parameters: np.ndarray) -> np.ndarray:
    """Return the commanded servo angles [rad] of each step of a swing through knots, shape (..., STEPS, 4).

    Args:
        parameters: the four angles over pi / 2 at each knot, shape (..., 4 KNOTS); larger ones than 1 are cut.
    """
    angles = 0.5 * np.pi * np.clip(parameters, -1.0, 1.0).reshape(*np.shape(parameters)[:-1], KNOTS, 4)
    knots = np.concatenate([np.zeros_like(angles[..., :1, :]), angles], axis=-2)
    place = np.minimum(np.arange(1, STEPS + 1) / (0.6 * STEPS), 1.0) * KNOTS
    first = np.minimum(place.astype(int), KNOTS - 1)
    part = (place - first)[:, None]
    return (1.0 - part) * knots[..., first, :] + part * knots[..., first + 1, :]


def swing(parameters: np.ndarray):
    """Return an agent that moves the servos through knots; see `swing_commands`."""
    commands = iter(swing_commands(np.asarray(parameters)))

    def act(observation: np.ndarray, env) -> np.ndarray:
        return env.spaces.action(next(commands), env.state.command)

    return act


def search(
    payload: float,
    generations: int,
    members: int = 32,
    deviation: float = 0.4,
    seed: int = 0,
    mesh: str = "published",
) -> dict[str, object]:
    """Search for the swing that gets farthest, in ``generations`` of ``members`` episodes after a random one."""
    from cmaes import CMA
    from tqdm import trange

    env = gymnasium.make_vec(
        "SoftGym/TetrapodCarry-v0",
        members,
        robot_options={"payload": payload, "mesh": mesh},
        max_episode_steps=10**6,
    )
    batch = env.unwrapped

    def reach(tried: np.ndarray) -> np.ndarray:
        """Return the farthest position of the centre to the right [mm] of each swing, shape (members,)."""
        farthest = np.full(members, -np.inf)
        env.reset(seed=seed)
        for command in swing_commands(tried).swapaxes(0, 1):
            env.step(batch.spaces.action(command, batch.backend.command))
            farthest = np.maximum(farthest, 1e3 * batch.backend.state.effector.reshape(members, 3)[:, 0])
        return farthest

    tried = np.random.default_rng(seed).uniform(-1.0, 1.0, (members, 4 * KNOTS))
    reached = reach(tried)
    best, farthest = tried[reached.argmax()], float(reached.max())
    search = CMA(mean=best, sigma=deviation, population_size=members, seed=seed)
    for _ in (bar := trange(generations, desc=f"swing with {payload:g} kg")):
        tried = np.array([search.ask() for _ in range(members)])
        reached = reach(tried)
        search.tell(list(zip(tried, -reached, strict=True)))
        if reached.max() > farthest:
            best, farthest = tried[reached.argmax()], float(reached.max())
        bar.set_postfix_str(f"{farthest:.1f} mm, median {np.median(reached):.1f} mm")
    env.close()
    episodes = (1 + generations) * members
    return {"payload": payload, "mesh": mesh, "parameters": best.tolist(), "episodes": episodes, "seed": seed}


def imitate(payload: float, path: Path, members: int = 32, hidden: int = 16, seed: int = 0) -> None:
    """Train a policy to imitate the stored swing, and save it with the configuration of the evolution it is for.

    The swing is a sequence of commands, the policy sees the state. Its examples are episodes whose actions are the
    swing's with different noise, each labelled with the action of the swing at its step.

    Args:
        payload: of the swing [kg].
        path: the policy, a ``.safetensors`` file.
        members: episodes for each size of the noise.
        hidden: units of the policy.
        seed: of the noise and the first weights.
    """
    import torch

    from softgym_envs.agents.config import TrainConfig
    from softgym_envs.agents.policy import save_policy
    from softgym_envs.config import load_config, provenance

    commands = swing_commands(np.array(_stored()["published", payload]["parameters"]))
    env = gymnasium.make_vec(
        "SoftGym/TetrapodCarry-v0", members, robot_options={"payload": payload}, max_episode_steps=10**6
    )
    batch, rng = env.unwrapped, np.random.default_rng(seed)
    seen, done = [], []
    for noise in (0.0, 0.02, 0.05, 0.1):
        observation, _ = env.reset(seed=seed)
        for command in commands:
            action = np.clip(batch.spaces.action(np.tile(command, (members, 1)), batch.backend.command), -1.0, 1.0)
            seen.append(observation.copy())
            done.append(action)
            observation, *_ = env.step(np.clip(action + noise * rng.standard_normal(action.shape), -1.0, 1.0))
    env.close()
    inputs, labels = (torch.tensor(np.concatenate(part), dtype=torch.float32) for part in (seen, done))
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    layers = torch.nn.Linear(inputs.shape[1], hidden), torch.nn.Linear(hidden, labels.shape[1])
    network = torch.nn.Sequential(layers[0], torch.nn.ReLU(), layers[1], torch.nn.Tanh())
    optimiser = torch.optim.Adam(network.parameters(), 3e-3)
    for _ in range(6000):
        rows = torch.randint(len(inputs), (256,))
        loss = ((network(inputs[rows]) - labels[rows]) ** 2).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    names = zip(("actor.latent_pi.0", "actor.mu"), layers, strict=True)
    tensors = {
        f"{name}.{part}": value.detach().numpy() for name, layer in names for part, value in layer.named_parameters()
    }
    config = load_config(CONFIG, TrainConfig)
    config = config.model_copy(update={"initial": None})
    save_policy(path, tensors, {"config": config.model_dump(mode="json"), "provenance": provenance()})


def _stored() -> dict[tuple[str, float], dict[str, Any]]:
    """Return the stored swings by mesh and payload."""
    return {(entry["mesh"], entry["payload"]): entry for entry in json.loads(DATA.read_text())}


def carry() -> dict[str, object]:
    """TetrapodCarry: farthest and last position [mm], return and folded steps of 100, by mesh, payload and agent."""
    from softgym_envs.agents.evaluation import make_agent
    from softgym_envs.agents.policy import policy_path
    from softgym_envs.robots.tetrapod import MESHES

    swings = _stored()
    results: dict[str, object] = {}
    for mesh in MESHES:
        for payload in PAYLOADS:
            env = make(payload, mesh)
            agents = {"quasi-static QP": make_agent("qp_static"), "one-step dynamic QP": make_agent("qp")}
            for searched in SEARCHED:
                agents[f"swing found on the {searched} mesh"] = swing(swings[searched, payload]["parameters"])
            agents |= {name: make_agent(policy_path(policy)) for name, policy in POLICIES.items()}
            for name, act in agents.items():
                farthest, last, total, folded = episode(env, act)
                key = f"{mesh}, {payload:g} kg, {name}: farthest, end [mm], return, folded"
                results[key] = f"{farthest:.1f}, {last:.1f}, {total:.2f}, {folded}"
            env.close()
    return results


if __name__ == "__main__":
    import argparse
    import sys

    from softgym_envs.storage import write_json

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    if sys.argv[1:2] == ["imitate"]:
        parser.add_argument("verb")
        parser.add_argument("payload", type=float, choices=PAYLOADS, help="of the stored swing [kg]")
        parser.add_argument("file", type=Path, help="of the policy, with the ending .safetensors")
        given = parser.parse_args()
        imitate(given.payload, given.file)
        sys.exit()
    parser.add_argument("payload", type=float, choices=PAYLOADS, help="[kg]")
    parser.add_argument("generations", type=int)
    parser.add_argument("seed", type=int, nargs="?", default=0)
    parser.add_argument("mesh", choices=SEARCHED, nargs="?", default="published")
    given = parser.parse_args()
    entries = _stored()
    found = search(given.payload, given.generations, seed=given.seed, mesh=given.mesh)
    env = make(given.payload, given.mesh)
    kept = entries[given.mesh, given.payload]
    before, after = (episode(env, swing(one["parameters"]))[0] for one in (kept, found))
    print(f"{after:.1f} mm; the stored swing {before:.1f} mm")
    env.close()
    if after > before:
        entries[given.mesh, given.payload] = found
    write_json(DATA, list(entries.values()))
