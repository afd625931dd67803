"""Run the snippets of this folder, each client in an environment of its own.

Usage: ``python examples/clients/run.py [NAME ...]``. An environment sees the packages of the Python that runs this
script. Only what a client needs on top of them, or pins to other versions, is installed into it, below build/clients.
"""

import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
BUILD = FOLDER.parents[1] / "build" / "clients"
DATA = BUILD / "episodes.npz"
#: Requirement, script and its arguments of each client.
CLIENTS = {
    "stable-baselines3": ("stable-baselines3", "stable_baselines3_ppo.py"),
    "sb3-contrib": ("sb3-contrib", "sb3_contrib_tqc.py"),
    "sbx": ("sbx-rl", "sbx_sac.py"),
    "rl-zoo": ("rl_zoo3", "rl_zoo.py"),
    "torchrl": ("torchrl", "torchrl_collector.py"),
    "tianshou": ("tianshou", "tianshou_collector.py"),
    "skrl": ("skrl", "skrl_ppo.py"),
    "rllib": ("ray[rllib]", "rllib_ppo.py"),
    "minari": ("minari[create,hdf5]", "minari_dataset.py", str(DATA)),
    "d3rlpy": ("d3rlpy", "d3rlpy_offline.py", str(DATA)),
}


def python_of(name: str, requirement: str) -> Path:
    """Return the interpreter of a client's environment, which is made if it does not exist."""
    folder = BUILD / name
    python = folder / "bin" / "python"
    if not (folder / "ready").exists():
        venv.create(folder, clear=True)
        site = sysconfig.get_path("purelib", vars={"base": str(folder), "platbase": str(folder)})
        # Packages of the project may have .pth files of their own, which addsitedir reads.
        lines = [f"import site; site.addsitedir({sysconfig.get_path('purelib')!r})", str(FOLDER.parents[1])]
        Path(site, "project.pth").write_text("\n".join(lines) + "\n")
        pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "-q", requirement]
        subprocess.run(pip, check=True)
        (folder / "ready").touch()
    return python


def main(names: list[str]) -> None:
    """Run the snippets of some clients, by default of all."""
    unknown = [name for name in names if name not in CLIENTS]
    if unknown:
        sys.exit(f"unknown client '{unknown[0]}'; allowed: {', '.join(CLIENTS)}")
    if "d3rlpy" in names and not DATA.exists():
        names = ["minari", *(name for name in names if name != "minari")]  # it records the data
    failed = []
    for name in names or CLIENTS:
        requirement, script, *arguments = CLIENTS[name]
        python = python_of(name, requirement)
        # Clients log progress, which only helps where one fails.
        result = subprocess.run(
            [python, FOLDER / script, *arguments],
            cwd=BUILD,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        print(f"{name:20s} {'ok' if result.returncode == 0 else 'FAILED'}", flush=True)
        if result.returncode != 0:
            failed.append(name)
            print(result.stderr, file=sys.stderr)
    sys.exit(f"failed: {', '.join(failed)}" if failed else 0)


if __name__ == "__main__":
    main(sys.argv[1:])
