"""How far to the right the Tetrapod moves with controllers, an optimised swing and learned policies.

``softgym bench carry`` compares them. ``python -m benchmarks.carry PAYLOAD GENERATIONS SEED`` searches for the swing:
servo angles through a few knots, optimised by CMA-ES on batched finite elements so that the centre gets as far as
possible. It shows what is possible at all. The search begins at the best of one generation of random swings, and what
it finds is kept if it gets farther than the stored swing.
"""

from __future__ import annotations

import json
from pathlib import Path

import gymnasium
import numpy as np

DATA = Path(__file__).parent / "data" / "tetrapod_swing.json"
POLICIES = {"SAC": "tetrapod_carry", "evolution": "tetrapod_carry_evolution"}
"""Shipped policies, by learner; both were trained with 1 kg."""
PAYLOADS = (0.0, 1.0)
KNOTS = 8
STEPS = 100


def make(payload: float) -> gymnasium.Env:
    import softgym_envs  # noqa: F401 - registers the IDs

    return gymnasium.make("SoftGym/TetrapodCarry-v0", robot_options={"payload": payload})


def episode(env: gymnasium.Env, act) -> tuple[float, float, float]:
    """Return the farthest and the last position to the right [mm], and the return, of one episode."""
    observation, _ = env.reset(seed=0)
    reached, total, ended = [], 0.0, False
    while not ended:
        observation, reward, terminated, truncated, info = env.step(act(observation, env.unwrapped))
        reached.append(1e3 * info["effector"][0])
        total, ended = total + float(reward), terminated or truncated
    return max(reached), reached[-1], total


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
    payload: float, generations: int, members: int = 32, deviation: float = 0.4, seed: int = 0
) -> dict[str, object]:
    """Search for the swing that gets farthest, in ``generations`` of ``members`` episodes after a random one."""
    from cmaes import CMA
    from tqdm import trange

    env = gymnasium.make_vec(
        "SoftGym/TetrapodCarry-v0", members, robot_options={"payload": payload}, max_episode_steps=10**6
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
    return {"payload": payload, "parameters": best.tolist(), "episodes": episodes, "seed": seed}


def carry() -> dict[str, object]:
    """TetrapodCarry: farthest position to the right, position at the end [mm] and return, by agent and payload."""
    from softgym_envs.agents.evaluation import make_agent
    from softgym_envs.agents.policy import policy_path

    swings = {entry["payload"]: entry["parameters"] for entry in json.loads(DATA.read_text())}
    results: dict[str, object] = {}
    for payload in PAYLOADS:
        env = make(payload)
        agents = {"quasi-static QP": make_agent("qp_static"), "one-step dynamic QP": make_agent("qp")}
        agents["optimised swing"] = swing(swings[payload])
        agents |= {f"{name}, trained with 1 kg": make_agent(policy_path(policy)) for name, policy in POLICIES.items()}
        for name, act in agents.items():
            farthest, last, total = episode(env, act)
            results[f"{payload:g} kg, {name}: farthest, end [mm], return"] = f"{farthest:.1f}, {last:.1f}, {total:.2f}"
        env.close()
    return results


if __name__ == "__main__":
    import sys

    from softgym_envs.storage import write_json

    payload, generations = float(sys.argv[1]), int(sys.argv[2])
    seed = int(sys.argv[3]) if sys.argv[3:] else 0
    entries = json.loads(DATA.read_text())
    found = search(payload, generations, seed=seed)
    env = make(payload)
    for k, entry in enumerate(entries):
        if entry["payload"] == payload:
            before, after = (episode(env, swing(one["parameters"]))[0] for one in (entry, found))
            print(f"{after:.1f} mm; the stored swing {before:.1f} mm")
            if after > before:
                entries[k] = found
    env.close()
    write_json(DATA, entries)
