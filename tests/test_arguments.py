"""Values of the wrong kind in every public function of the mechanics: refused in one line, whatever fails inside."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

import softgym_envs  # noqa: F401 - registers the environments
from softgym_envs import DesignSpace, DesignVariable
from softgym_envs.arguments import _is_raised, choice, explained, is_a
from softgym_envs.backends import make_backend
from softgym_envs.errors import SoftGymError
from softgym_envs.extensions.beams import Beam, Section, add_rod
from softgym_envs.mechanics import MechanicalModel, Statics
from softgym_envs.mechanics.builder import ModelBuilder
from softgym_envs.mechanics.contact.contact import ContactSettings
from softgym_envs.mechanics.io import read_mesh
from softgym_envs.mechanics.solvers.dynamics import Dynamics
from softgym_envs.robots import Actuator
from tests.helpers import box_mesh
from tests.test_units import Bar

NODES, TETRAHEDRA = box_mesh((0.1, 0.02, 0.02), (2, 1, 1))
CLAMPED = NODES[:, 0] == 0.0
BAD = {
    "none": None,
    "text": "x",
    "bytes": b"x",
    "list": [],
    "mapping": {"a": {"b": 1}},
    "not finite": float("nan"),
    "object": object(),
    "ragged": [[1], [2, 3]],
    "empty": np.array([]),
    "matrix": np.zeros((2, 2)),
    "texts": np.array(["a", "b"]),
    "set": {1},
    "class": int,
    "complex": 1j,
    "negative": -1,
    "enormous": 10**30,
}


def body(nodes=NODES, tetrahedra=TETRAHEDRA, fixed=CLAMPED, element="averaged", young_modulus=3e5, **options):
    return MechanicalModel.from_mesh(
        nodes, tetrahedra, fixed=fixed, element=element, young_modulus=young_modulus, **options
    )


def builder(method, **arguments):
    return getattr(ModelBuilder(), method)(**arguments)


def beam(**options):
    made = ModelBuilder()
    given = {"section": Section.circle(5e-3), "young_modulus": 1e6, **options}
    made.add_element(Beam, [made.add_frame([x, 0.0, 0.0], fixed=x == 0.0) for x in (0.0, 0.05, 0.1)], **given)
    return made.build()


def rod(**options):
    made = ModelBuilder()
    given = {"section": Section.circle(5e-4), "elements": 10, "up": [1, 0, 0], "young_modulus": 1e9, **options}
    rod = add_rod(made, **{"path": [[0, 0, 0], [0, 0, 0.2]], **given})
    return made.build(), rod


def tendon(*arguments, **options):
    model, made = rod()
    return made.add_tendon(model, *arguments, **options)


def solved(**arguments):
    model = body()
    model.add_cable("cable", [[0.02, 0.01, 0.015], [0.09, 0.01, 0.015]], [0.0, 0.01, 0.015])
    return Statics(model).solve(**{"target": [0.001], **arguments})


def environment(**options):
    env = gymnasium.make("SoftGym/Reach-v0", robot=Bar, backend="fem", **options)
    env.reset(seed=0)


# Call -> its arguments, each of which takes the wrong values in turn, and which of these it may take.
ENTRIES = {
    "from_mesh": (body, {"nodes", "tetrahedra", "fixed", "element", "young_modulus", "poisson_ratio", "density"}),
    "from_mesh, others": (body, {"material", "gravity", "check"}),
    "add_cable": (
        lambda **a: body().add_cable(**{"name": "c", "points": [[0.05, 0.01, 0.01]], "pull_point": np.zeros(3), **a}),
        {"name", "points", "pull_point", "block", "radius"},
    ),
    "add_effector": (
        lambda **a: body().add_effector(**{"name": "e", "point": [0.1, 0.01, 0.01], **a}),
        {"name", "point", "block", "radius"},
    ),
    "add_load": (
        lambda **a: body().add_load(**{"name": "l", "force": [0, 0, 1.0], "on": CLAMPED, **a}),
        {"force", "on"},
    ),
    "set_contact": (lambda **a: body().set_contact(**a), {"obstacles", "excluded", "settings"}),
    "contact settings": (
        lambda **a: body().set_contact(settings=ContactSettings(**a)),
        {"self_contact", "distance", "stiffness", "self_friction"},
    ),
    "add_frame": (lambda **a: builder("add_frame", **{"position": [0, 0, 0], **a}), {"position"}),
    "add_beam": (beam, {"section", "young_modulus", "order", "density"}),
    "add_rod": (rod, {"section", "elements", "up", "young_modulus", "held"}),
    "add_tendon": (
        lambda **a: tendon(**{"name": "t", "places": [0.1, 0.2], "offsets": [0.004, 0.0], **a}),
        {"name", "places", "offsets", "compliance", "unilateral"},
    ),
    "Statics": (lambda **a: Statics(**{"model": body(), **a}), {"model", "tolerance", "max_iterations"}),
    "solve": (solved, {"target", "mode", "effector_force", "contact_mode"}),
    "Dynamics": (lambda **a: Dynamics(body(), **{"step": 0.01, **a}), {"step", "scheme", "stiffness_damping"}),
    "read_mesh": (read_mesh, {"path"}),
    "design variable": (
        lambda **a: DesignVariable(
            **{"name": "a", "low": 0.01, "high": 0.02, "baseline": 0.015, "unit": "m", "description": "", **a}
        ),
        {"name", "low", "high", "baseline", "unit", "log"},
    ),
    "actuator": (
        lambda **a: Actuator(**{"name": "a", "low": 0.0, "high": 0.02, "rate": 0.001, **a}),
        {"name", "low", "high", "rate", "unit", "unilateral"},
    ),
    "designs": (lambda **a: DesignSpace(*Bar.design_space).from_unit(**a), {"vector"}),
    "backend": (lambda **a: make_backend("fem", Bar()).step(**{"command": [0.0], **a}), {"command", "mode", "force"}),
    "environment": (
        environment,
        {"design", "sample_design", "action_mode", "robot_options", "task_options", "backend_options", "plant"},
    ),
}
MEANT = {
    *(("list", name) for name in ("sample_design", "obstacles", "excluded", "effector_force", "path")),
    *(("none", name) for name in ("settings", "effector_force", "up", "force", "design", "robot_options", "plant")),
    *(("none", name) for name in ("stiffness", "task_options", "backend_options")),
    *(("empty", name) for name in ("sample_design", "obstacles", "excluded", "effector_force")),
    *(("negative", name) for name in ("low", "rod", "offsets")),
    *(("text", "name"), ("matrix", "offsets"), ("enormous", "max_iterations")),
}
"""Values that are meant: empty lists, None where there is a default, numbers of either sign."""


@pytest.mark.filterwarnings("ignore:invalid value encountered in cast", "ignore:Casting complex values")
@pytest.mark.parametrize(
    ("entry", "name"), [(entry, name) for entry, (_, names) in ENTRIES.items() for name in sorted(names)]
)
def test_wrong_kinds_end_with_one_line(entry, name):
    call, _ = ENTRIES[entry]
    for kind, value in BAD.items():
        try:
            call(**{name: value})
        except (SoftGymError, ValueError, TypeError, gymnasium.error.Error) as error:
            # Gymnasium raises what the environment raised anew, with a line of its own.
            causes = (error, error.__cause__, error.__context__) if entry == "environment" else (error,)
            assert any(_is_raised(each) for each in causes if each is not None), f"{kind}: {error!r}"
            assert "\n" not in str(error), f"{kind}: {error!r}"
        else:
            assert (kind, name) in MEANT, kind


def test_errors_of_a_callers_code_keep_their_traceback():
    with pytest.raises(IndexError, match="out of bounds"):
        body(fixed=lambda x: x[:, 3] == 0.0)

    @explained
    def scale(values: np.ndarray, factor: float = 1.0, name: str = "") -> np.ndarray:
        return np.asarray(values) * factor * np.ones(3)

    np.testing.assert_array_equal(scale(np.ones(3), np.float64(2.0)), [2.0, 2.0, 2.0])
    with pytest.raises(ValueError, match=r"^scale: factor = 'x' must be a number$"):
        scale(np.ones(3), "x")
    with pytest.raises(ValueError, match=r"^operands could not be broadcast"):
        scale([1, 2])
    with pytest.raises(ValueError, match=r"tendon cannot take .* places = \[\[0.1\]\], offsets = .*broadcast"):
        tendon("t", [[0.1]], np.zeros((3, 3)))
    with pytest.raises(TypeError, match="unexpected keyword argument 'nme'"):
        scale([1.0], nme="x")


def test_kinds():
    assert is_a(np.int64(3), int) and is_a(3, float) and not is_a(True, int) and not is_a("3", float)
    assert is_a(np.bool_(True), bool) and is_a(np.float32(1.0), float) and not is_a(1, bool)
    assert is_a([1, 2], tuple[int, int]) and not is_a([1], tuple[int, int])
    assert choice("mode", "effort", ("displacement", "effort")) == "effort"
    with pytest.raises(ValueError, match=r"mode = \[1, 2\] is unknown; allowed: 'displacement', 'effort'"):
        choice("mode", [1, 2], ("displacement", "effort"))
