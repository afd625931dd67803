"""The pneumatic bender of pneunet.py on a laboratory's drives: two pressure valves and a tendon on a servo's drum."""

from pneunet import PneuNet

from softgym_envs.robots import Actuator

VALVE = {"unit": "m3", "max_effort": 12e3, "effort_rate": 600.0}  # commands up to 12 kPa, by 0.6 kPa in a step


class ValveBender(PneuNet):
    """Chambers are commanded in pressure; their volumes, up to 4 cm3, are what then occurs. The tendon is pulled in."""

    name = "valve_bender"
    actuators = (
        Actuator("left", 0.0, 4e-6, 4e-7, **VALVE),
        Actuator("right", 0.0, 4e-6, 4e-7, **VALVE),
        Actuator("tendon", 0.0, 0.008, 0.0008),
    )
