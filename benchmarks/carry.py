"""How far to the right the Tetrapod moves with controllers, an optimised swing and learned policies.

``softgym bench carry`` compares them. ``python -m benchmarks.carry`` searches for the swing again (half an hour): servo
angles through a few knots, optimised by differential evolution on finite elements so that the centre gets as far as
possible. It shows what is possible at all.
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
KNOTS = 4
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


def swing(parameters: np.ndarray):
    """Return an agent that moves the servos through knots.

    Args:
        parameters: (front, both sides, back) angles over pi / 2 at each knot, shape (3 KNOTS,).
    """
    angles = 0.5 * np.pi * np.asarray(parameters).reshape(KNOTS, 3)[:, [0, 1, 2, 1]]
    times = np.linspace(0.0, 0.6 * STEPS, KNOTS + 1)
    step = iter(range(1, STEPS + 1))

    def act(observation: np.ndarray, env) -> np.ndarray:
        k = next(step)
        path = np.vstack([np.zeros(4), angles])
        command = np.array([np.interp(k, times, path[:, j]) for j in range(4)])
        return env.spaces.action(command, env.state.command)

    return act


def search(payload: float, generations: int = 8, members: int = 2, seed: int = 0) -> dict[str, object]:
    """Search for the swing that gets farthest, in about ``12 members (generations + 1)`` episodes."""
    from scipy.optimize import differential_evolution
    from tqdm import tqdm

    env = make(payload)
    bar = tqdm(desc=f"swing with {payload:g} kg", unit="episode")
    best = [0.0]

    def lost(parameters: np.ndarray) -> float:
        farthest = episode(env, swing(parameters))[0]
        best[0] = max(best[0], farthest)
        bar.update()
        bar.set_postfix_str(f"{best[0]:.1f} mm")
        return -farthest

    straight = np.tile([1.0, -1.0, -1.0], KNOTS)
    back_first = np.concatenate([[-1.0, -1.0, 1.0], np.tile([1.0, -1.0, -1.0], KNOTS - 1)])
    rng = np.random.default_rng(seed)
    start = rng.uniform(-1.0, 1.0, (12 * members, 3 * KNOTS))
    start[0], start[1] = straight, back_first
    found = differential_evolution(
        lost, [(-1.0, 1.0)] * (3 * KNOTS), init=start, maxiter=generations, polish=False, rng=seed, tol=0.0
    )
    bar.close()
    env.close()
    return {"payload": payload, "parameters": found.x.tolist(), "episodes": int(found.nfev), "seed": seed}


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
    from softgym_envs.storage import write_json

    write_json(DATA, [search(payload) for payload in PAYLOADS])
