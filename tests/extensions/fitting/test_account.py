"""What a fit refuses before it solves any state, and what it says in the end."""

from __future__ import annotations

import pytest

from softgym_envs import make_robot
from softgym_envs.errors import ConfigError
from softgym_envs.extensions.fitting.account import account
from softgym_envs.extensions.fitting.training import FitConfig, generate_datasets
from softgym_envs.robots.soft_finger import SoftFinger

SPLIT = {"groups": 2, "states": 2}
DATA = {name: SPLIT for name in ("train", "validation", "test")}
PLANE = {"kind": "plane", "point": [0.0, 0.0, -0.2], "normal": [0.0, 0.0, 1.0]}


def config(robot, **options):
    return FitConfig.model_validate({"robot": robot, "data": DATA, **options})


class StretchingFinger(SoftFinger):
    """A finger with a cable that stretches."""

    def assemble(self, design):
        model = super().assemble(design)
        model.constraints["a"][0].compliance = 1e-4
        return model


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        (config(f"{__name__}:StretchingFinger"), "the drives of cable_1 stretch, which a surrogate does not learn"),
        (
            config("finger", robot_options={"obstacles": [PLANE]}),
            "'finger' touches obstacles, which a surrogate",
        ),
        (
            config("finger", data={**DATA, "within": "composed_gripper"}),
            r"data.within = 'composed_gripper': its part is 'contact_finger', not 'finger'",
        ),
        (config("finger", data={**DATA, "within": "trunk"}), "data.within = 'trunk': it has no parts to learn"),
        (config("modular_arm"), r"would drive .* beyond max_effort: leave it out .* or set alone = false"),
    ],
)
def test_what_no_backend_would_take_is_refused_before_any_data(tmp_path, wanted, message):
    with pytest.raises(ConfigError, match=message):
        generate_datasets(wanted, tmp_path / "data", progress=False)
    assert not (tmp_path / "data").exists()


CARD = {
    "states": {"train": 40, "test": 18},
    "unstable_states_left_out": {"train": 3, "test": 0},
    "lost": {"train": (1, 53, 7), "test": (0, 0, 0)},
    "test": {"states": 18},
    "trusted": {
        "share": 0.12,
        "effector_p95": 1.2e-3,
        "elsewhere_p95": 9.6e-3,
        "reasons": {"spread": 0.7, "outside box": 0.18},
        "effort": [3e3, 12.0],
    },
}


def test_what_a_fit_says():
    lines = account(make_robot("finger"), CARD)
    assert lines[0] == (
        "train: 40 states; lost: 1 body that cannot be built or held, 53 commands without an equilibrium, "
        "7 states outside the ranges of the actuators, 3 states too unstable to learn"
    )
    assert lines[1] == "test: 18 states; lost: nothing"
    assert lines[2].startswith("'cable_1' needs up to 3e+03 N, 150 times its effort_scale")
    assert lines[3] == (
        "It can be trusted on 12% of 18 test states of new bodies, where 95 % of the errors of the effector are below "
        "1.2 mm; elsewhere below 9.6 mm."
    )
    assert lines[4] == "Not trusted because of: spread 70%, outside box 18%."
    assert lines[5].startswith("Take more bodies") and len(lines) == 6
