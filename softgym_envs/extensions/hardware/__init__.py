"""Physical robots in real time: Dynamixel servos, pressure boards, and benches of your own.

An environment on the backend ``"hardware"`` drives the robot: policies, the inverse QP and the embedded loop need no
other code. See docs/hardware.md.
"""

from typing import TYPE_CHECKING

from softgym_envs._lazy import lazy_exports

if TYPE_CHECKING:
    from softgym_envs.extensions.hardware.backend import HardwareBackend as HardwareBackend
    from softgym_envs.extensions.hardware.bench import Bench as Bench
    from softgym_envs.extensions.hardware.bench import BenchConfig as BenchConfig
    from softgym_envs.extensions.hardware.device import Device as Device
    from softgym_envs.extensions.hardware.device import HardwareError as HardwareError
    from softgym_envs.extensions.hardware.device import Reading as Reading
    from softgym_envs.extensions.hardware.simulated_time import emulated_bench as emulated_bench

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "backend": ["HardwareBackend"],
        "bench": ["Bench", "BenchConfig"],
        "device": ["Device", "HardwareError", "Reading"],
        "simulated_time": ["emulated_bench"],
    },
)
