"""Design spaces: validation, defaults, unit vectors, samples."""

from __future__ import annotations

import copy
import math
import pickle

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from softgym_envs import make_robot
from softgym_envs.designs import DesignSpace, DesignVariable
from softgym_envs.errors import DesignError, SoftGymError
from softgym_envs.robots import ROBOTS

SPACE = DesignSpace(
    DesignVariable("length", 0.038, 0.042, 0.040, "m", "length of a segment"),
    DesignVariable("young_modulus", 1.0e6, 1.0e7, 3.0e6, "Pa", "stiffness", log=True),
    DesignVariable("offset", -2.0, 1.0, 0.5, "1", "a pure number"),
)


@st.composite
def spaces(draw):
    """Any design space of one to four variables of any magnitude."""
    variables = []
    for k in range(draw(st.integers(1, 4))):
        log = draw(st.booleans())
        low = draw(st.floats(1e-9, 1e9) if log else st.floats(-1e9, 1e9))
        width = draw(st.floats(1e-3, 1e3)) * max(abs(low), 1e-6)
        fraction = draw(st.floats(0.0, 1.0))
        baseline = min(max(low + fraction * width, low), low + width)
        variables.append(DesignVariable(f"v{k}", low, low + width, baseline, "1", "any", log=log))
    return DesignSpace(*variables)


def units(space):
    return st.lists(st.floats(-1.0, 1.0), min_size=len(space), max_size=len(space))


@given(st.data())
def test_unit_vectors_make_the_round_trip(data):
    space = data.draw(spaces())
    vector = np.array(data.draw(units(space)))
    design = space.from_unit(vector)
    assert tuple(design) == space.names
    for name, value in design.items():
        assert isinstance(value, float)
        assert space[name].low <= value <= space[name].high
    # Round-off of a value next to its bounds, as a part of the box: |low| / width is at most 1e3 here.
    np.testing.assert_allclose(space.to_unit(design), vector, rtol=0, atol=1e-11)
    assert space.complete(design) == design


@given(st.data())
def test_designs_make_the_round_trip(data):
    space = data.draw(spaces())
    design = {n: data.draw(st.floats(space[n].low, space[n].high)) for n in space.names}
    vector = space.to_unit(design)
    assert vector.shape == (len(space),)
    assert (np.abs(vector) <= 1.0 + 1e-9).all()
    for name, value in space.from_unit(vector).items():
        variable = space[name]
        # A logarithmic value is kept to its own digits, a linear one to those of its box.
        assert abs(value - design[name]) <= 1e-12 * (abs(variable.low) + abs(variable.high))


@given(st.data())
def test_partial_designs_are_filled_from_the_baseline(data):
    space = data.draw(spaces())
    given_names = data.draw(st.sets(st.sampled_from(space.names)))
    design = {n: data.draw(st.floats(space[n].low, space[n].high)) for n in given_names}
    before = dict(design)
    complete = space.complete(design)
    assert tuple(complete) == space.names
    assert complete == {**space.baseline, **design}
    assert design == before


@given(st.data())
def test_values_outside_the_box_are_refused(data):
    space = data.draw(spaces())
    name = data.draw(st.sampled_from(space.names))
    variable = space[name]
    width = variable.high - variable.low
    beyond = data.draw(st.floats(1e-5, 1e6)) * width
    value = variable.high + beyond if data.draw(st.booleans()) else variable.low - beyond
    assume(math.isfinite(value))
    with pytest.raises(DesignError, match=f"'{name}'.*out of bounds; allowed"):
        space.complete({name: value})


@given(st.data())
def test_unit_values_outside_are_clipped(data):
    space = data.draw(spaces())
    vector = np.array(data.draw(st.lists(st.floats(-1e3, 1e3), min_size=len(space), max_size=len(space))))
    clipped = space.from_unit(np.clip(vector, -1.0, 1.0))
    assert space.from_unit(vector) == pytest.approx(clipped, rel=1e-12)


@given(st.data())
def test_samples_are_in_the_box_and_leave_the_others(data):
    space = data.draw(spaces())
    names = tuple(sorted(data.draw(st.sets(st.sampled_from(space.names)))))
    seed = data.draw(st.integers(0, 1000))
    design = space.sample(np.random.default_rng(seed), names)
    assert space.complete(design) == design
    assert design == space.sample(np.random.default_rng(seed), names)
    for name in set(space.names) - set(names):
        assert design[name] == space[name].baseline


def test_logarithmic_variables_are_centred_on_the_geometric_mean():
    variable = SPACE["young_modulus"]
    assert variable.from_unit(0.0) == pytest.approx(math.sqrt(1e6 * 1e7))
    assert variable.to_unit(math.sqrt(1e6 * 1e7)) == pytest.approx(0.0, abs=1e-12)
    samples = [SPACE.sample(np.random.default_rng(k))["young_modulus"] for k in range(400)]
    assert np.mean(np.log10(samples)) == pytest.approx(6.5, abs=0.05)


def test_ends_of_the_box_are_met_exactly():
    low, high = SPACE.from_unit(-np.ones(3)), SPACE.from_unit(np.ones(3))
    for name in SPACE.names:
        assert low[name] == pytest.approx(SPACE[name].low, rel=1e-15)
        assert high[name] == pytest.approx(SPACE[name].high, rel=1e-15)
    assert SPACE.complete(low) == low
    assert SPACE.complete(high) == high


def test_single_precision_and_text_round_trips_are_not_out_of_bounds():
    for name in SPACE.names:
        for bound in (SPACE[name].low, SPACE[name].high):
            for value in (np.float32(bound), np.float64(bound), float(f"{bound:.9g}")):
                checked = SPACE.complete({name: value})[name]
                assert checked == pytest.approx(bound, rel=1e-6)
                assert SPACE[name].low <= checked <= SPACE[name].high


def test_none_and_an_empty_mapping_give_the_baseline():
    assert SPACE.complete() == SPACE.complete(None) == SPACE.complete({}) == SPACE.baseline
    with pytest.raises(TypeError):
        SPACE.baseline["length"] = 0.0
    assert SPACE.baseline["length"] == 0.040


def test_a_design_is_checked_once_and_never_changes():
    design = SPACE.complete({"length": 0.041})
    assert SPACE.complete(design) is design
    assert copy.deepcopy(SPACE).complete(design) is design  # an equal space is the same box
    np.testing.assert_array_equal(design.array, [0.041, 3e6, 0.5])
    with pytest.raises(ValueError, match="read-only"):
        design.array[0] = 0.04
    assert design == {"length": 0.041, "young_modulus": 3e6, "offset": 0.5}
    assert dict(design) == {**design}
    assert hash(design) == hash(SPACE.complete({"length": 0.041}))
    assert repr(design) == "Design(length=0.041, young_modulus=3e+06, offset=0.5)"
    for again in (copy.deepcopy(design), pickle.loads(pickle.dumps(design))):
        assert again == design
        assert again.space == SPACE


def test_a_design_of_another_space_is_checked_again():
    narrow = DesignSpace(DesignVariable("length", 0.038, 0.0405, 0.040, "m", "narrower"))
    with pytest.raises(DesignError, match="'length' = 0.041 m is out of bounds"):
        narrow.complete(DesignSpace(SPACE["length"]).complete({"length": 0.041}))
    with pytest.raises(DesignError, match="unknown design variable 'young_modulus'"):
        narrow.complete(SPACE.baseline)


def test_variables_that_are_not_given_come_from_another_design():
    base = SPACE.complete({"length": 0.041, "offset": 0.1})
    assert SPACE.complete({"offset": 0.2}, base) == {"length": 0.041, "young_modulus": 3e6, "offset": 0.2}
    assert SPACE.complete({"offset": 0.2}, {"length": 0.042})["length"] == 0.042
    with pytest.raises(DesignError, match="'length' = 1 m is out of bounds"):
        SPACE.complete({"offset": 0.2}, {"length": 1.0})


@pytest.mark.parametrize(
    ("design", "message"),
    [
        (
            {"lenght": 0.04},
            r"variable 'lenght'; did you mean 'length'\? allowed: length, young_modulus, offset",
        ),
        ({3: 0.04}, "unknown design variable '3'"),
        ({"length": 0.05}, r"design variable 'length' = 0.05 m is out of bounds; allowed: 0.038 to 0.042 m"),
        ({"offset": 7}, r"'offset' = 7 is out of bounds; allowed: -2 to 1$"),
        ({"length": float("nan")}, r"'length' = nan is not finite; allowed: 0.038 to 0.042 m"),
        ({"length": float("inf")}, "'length' = inf is not finite"),
        ({"length": "forty"}, "'length' = 'forty' is not a number; allowed"),
        ({"length": None}, "'length' = None is not a number"),
        ({"length": [0.04, 0.04]}, "'length'.* is not a number"),
        ({"length": 0.04j}, "'length' = 0.04j is not a number"),
        ({"length": 10**400}, "'length'"),
        ([0.04, 3e6, 0.5], "a design is a mapping .* got list"),
        ("length=0.04", "a design is a mapping .* got str"),
    ],
    ids=lambda p: None if isinstance(p, str) and len(p) > 20 else str(p)[:30],
)
def test_malformed_designs_name_the_thing_its_value_and_what_is_allowed(design, message):
    with pytest.raises(DesignError, match=message) as caught:
        SPACE.complete(design)
    assert isinstance(caught.value, SoftGymError)
    assert isinstance(caught.value, ValueError)
    with pytest.raises(DesignError):
        SPACE.to_unit(design)


@pytest.mark.parametrize(
    ("vector", "message"),
    [
        ([0.0, 0.0], r"shape \(3,\), got \(2,\)"),
        ([[0.0, 0.0, 0.0]], r"got \(1, 3\)"),
        (0.0, r"got \(\)"),
        ([0.0, np.nan, 0.0], "must be finite"),
        ([0.0, np.inf, 0.0], "must be finite"),
    ],
)
def test_malformed_unit_vectors(vector, message):
    with pytest.raises(DesignError, match=message):
        SPACE.from_unit(vector)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"low": 1.0, "high": 1.0}, "low 1.0 must be below high 1.0"),
        ({"low": 2.0}, "must be below"),
        ({"low": float("nan")}, "'v'"),
        ({"high": float("nan")}, "'v'"),
        ({"low": float("-inf")}, "'v'"),
        ({"high": float("inf")}, "'v'"),
        ({"baseline": 1.5}, r"baseline 1.5 is outside \[0.5, 1.0\]"),
        ({"baseline": float("nan")}, "baseline nan"),
        ({"low": -1.0, "log": True}, "logarithmic scale needs low > 0"),
        ({"choices": ("a", "b")}, "2 choices need a linear scale from 0 to 2, got 0.5 to 1.0"),
    ],
    ids=str,
)
def test_impossible_variables(change, message):
    arguments = {"name": "v", "low": 0.5, "high": 1.0, "baseline": 0.7, "unit": "m", "description": "", **change}
    with pytest.raises(DesignError, match=message):
        DesignVariable(**arguments)


def test_robots_can_be_copied_and_pickled():
    for name in ROBOTS:
        robot = make_robot(name)
        for again in (copy.deepcopy(robot), pickle.loads(pickle.dumps(robot))):
            assert again.design_space.variables == robot.design_space.variables
            assert again.mechanics_key == robot.mechanics_key


def test_names_must_differ():
    with pytest.raises(DesignError, match="distinct names"):
        DesignSpace(SPACE["length"], SPACE["length"])


def test_unknown_variable_by_name():
    with pytest.raises(DesignError, match="unknown design variable 'width'; allowed: length, young_modulus, offset"):
        SPACE["width"]
    with pytest.raises(DesignError, match="unknown design variable 'width'"):
        SPACE.sample(np.random.default_rng(0), ("width",))
    assert len(SPACE) == 3
    assert repr(SPACE) == "DesignSpace(length, young_modulus, offset)"


def test_a_space_with_other_bounds():
    space = make_robot("finger").design_space
    wide = space.within({"length": (0.03, 0.05)})
    assert (wide["length"].low, wide["length"].high) == (0.03, 0.05)
    assert wide.names == space.names and wide["height"] == space["height"] and wide.baseline == dict(space.baseline)
    assert space.within({}) == space != wide
    with pytest.raises(DesignError, match="'length': baseline 0.04 is outside"):
        space.within({"length": (0.05, 0.06)})
    with pytest.raises(DesignError, match="'width'"):
        space.within({"width": (0.0, 1.0)})


def test_choices_are_shown_one_by_one_and_kept_at_their_middles():
    """A value anywhere in the interval of a choice is the same body; the upper bound is the last choice."""
    kind = DesignVariable("kind", 0.0, 3.0, 0.5, "-", "", choices=("leaf", "block", "none"))
    space = DesignSpace(SPACE["length"], kind)
    assert [kind.choice(value) for value in (0.0, 0.99, 1.0, 2.5, 3.0)] == ["leaf", "leaf", "block", "none", "none"]
    assert space.complete({"kind": 1.9}) == space.complete({"kind": 1.0}) and space.complete({"kind": 3})["kind"] == 2.5
    assert kind.from_unit(np.linspace(-1.0, 1.0, 5)).tolist() == [0.5, 0.5, 1.5, 2.5, 2.5]
    designs = np.array([space.complete({"kind": value}).array for value in (0.0, 1.5, 3.0)])
    shown = space.observe(designs, ["kind", "length"])
    np.testing.assert_array_equal(shown[:, :3], np.eye(3))
    np.testing.assert_array_equal(shown[:, 3], space["length"].to_unit(designs[:, 0]))
    assert space.observe(designs, []).shape == (3, 0)
    drawn = {space.sample(np.random.default_rng(seed))["kind"] for seed in range(20)}
    assert drawn == {0.5, 1.5, 2.5}


def test_choices_are_given_by_name_or_value():
    kind = DesignVariable("kind", 0.0, 3.0, 0.5, "1", "module", choices=("leaf", "block", "hinge"))
    space = DesignSpace(kind)
    assert space.complete({"kind": "block"})["kind"] == space.complete({"kind": 1.2})["kind"] == 1.5
    assert kind.choice(space.complete({"kind": "block"})["kind"]) == "block"
    with pytest.raises(DesignError, match=r"'kind': unknown choice 'blok'; did you mean 'block'\?"):
        space.complete({"kind": "blok"})
