"""Bodies of beams: elements, rods, the compiled solver of their motions, robots made of them, and learned parts."""

from typing import TYPE_CHECKING

from softgym_envs._lazy import lazy_exports

if TYPE_CHECKING:
    from softgym_envs.extensions.beams.beam import Beam as Beam
    from softgym_envs.extensions.beams.beam import Section as Section
    from softgym_envs.extensions.beams.chamber import Chamber as Chamber
    from softgym_envs.extensions.beams.prism import RoundedPrism as RoundedPrism
    from softgym_envs.extensions.beams.rods import add_rod as add_rod
    from softgym_envs.extensions.beams.servo import Servo as Servo
    from softgym_envs.extensions.beams.slide import Slide as Slide

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "beam": ["Beam", "Section"],
        "chamber": ["Chamber"],
        "prism": ["RoundedPrism"],
        "rods": ["add_rod"],
        "servo": ["Servo"],
        "slide": ["Slide"],
    },
)
