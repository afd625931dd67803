"""CPU time of a step: ``python peers.py softgym|softrobot|mujoco|evogym`` in an environment that has the package."""

import sys
import time


def cpu(call, count):
    """CPU milliseconds of a call."""
    began = time.process_time()
    for _ in range(count):
        call()
    return 1e3 * (time.process_time() - began) / count


def step_time(environment, count):
    environment.reset(seed=0)
    for _ in range(3):
        environment.step(environment.action_space.sample())
    return cpu(lambda: environment.step(environment.action_space.sample()), count)


def softgym():
    import gymnasium
    import softgym_envs  # noqa: F401

    for name, backend, count in (("FingerReach", "surrogate", 2000), ("FingerReach", "fem", 40), ("TetrapodReach", "fem", 100)):
        env = gymnasium.make(f"SoftGym/{name}-v0", backend=backend, max_episode_steps=10**6)
        print(f"{name} on {backend}: {step_time(env, count):.3f} ms")
    envs = gymnasium.make_vec("SoftGym/FingerReach-v0", num_envs=1024)
    envs.reset(seed=0)
    actions = envs.action_space.sample()
    envs.step(actions)
    print(f"FingerReach, 1024 in a batch: {1e3 * cpu(lambda: envs.step(actions), 20) / 1024:.2f} us")


def softrobot():
    import gym_softrobot  # noqa: F401
    import gymnasium

    for name in ("SoftPendulum-v0", "ContinuumSnake-v0", "SoftArmTracking-v0"):
        print(f"{name}: {step_time(gymnasium.make(name), 10):.2f} ms")


def mujoco():
    import mujoco as engine

    beam = """<mujoco><option timestep="0.002" integrator="discrete"/><worldbody>
      <flexcomp name="beam" type="grid" dim="3" count="13 3 3" spacing="0.01 0.01 0.01" mass="0.05" radius="0.001">
      <pin gridrange="0 0 0 0 2 2"/><edge equality="false"/><contact selfcollide="none"/>
      <elasticity young="3e6" poisson="0.3" damping="0.001"/></flexcomp></worldbody></mujoco>"""
    model = engine.MjModel.from_xml_string(beam)
    data = engine.MjData(model)
    print(f"flex of {model.flex_elemnum[0]} tetrahedra, 50 ms: {25 * cpu(lambda: engine.mj_step(model, data), 100):.1f} ms")


def evogym():
    import evogym.envs
    import gymnasium
    import numpy

    numpy.random.seed(0)
    body, _ = evogym.sample_robot((5, 5))
    print(f"Walker-v0: {step_time(gymnasium.make('Walker-v0', body=body), 200):.2f} ms")


if __name__ == "__main__":
    {"softgym": softgym, "softrobot": softrobot, "mujoco": mujoco, "evogym": evogym}[sys.argv[1]]()
