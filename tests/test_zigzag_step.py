"""One step along the sensitivities of a finger."""

from benchmarks.zigzag_step import step


def test_variables_that_raise_the_force_go_to_their_better_end():
    design = {"e1": 0.010, "d0": 0.020, "d1": 0.020, "d2": 0.020}
    bounds = {"e1": (0.009, 0.011), "d0": (0.018, 0.022), "d1": (0.019, 0.021), "d2": (0.019, 0.021)}
    forces = [2.0, 1.9, 2.09, 2.4, 1.8, 2.07, 2.07, 2.2, 2.3]
    assert step(design, bounds, forces) == {"e1": 0.011, "d0": 0.018, "d1": 0.020, "d2": 0.021}
