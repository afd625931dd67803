"""C functions of a learned model whose body depends on loads: they compute the constants of a body where they run."""

from __future__ import annotations

import numpy as np

from softgym_envs.extensions.deployment.c_text import definitions, dimensions, functions, names_of, single_precision
from softgym_envs.extensions.deployment.surrogate_c import SIZES, body_constants, macros, network_constants, sizes_of
from softgym_envs.surrogate.potential.model import Model, coefficient_sizes

_SIZES = SIZES | {
    "E": ("COORDINATES", "e: three for each effector, then one for each sensor"),
    "L": ("LOADS", "numbers that a body depends on"),
    "D": ("DESIGN_WIDTH", "hidden units of the layers of the design"),
    "O": ("OUTPUTS", "outputs of these layers"),
}


def loaded_text(model: Model, design: np.ndarray, loads: np.ndarray, name: str) -> tuple[str, int]:
    """Return the functions of bodies whose design is ``design + load . loads``, and the bytes of their constants.

    ``<name>_body_under`` computes a body; ``<name>_state`` and ``<name>_condensed`` take it as first argument. Sensors
    are rows of the effector, in the network's units [m].

    Args:
        model: the ensemble, with an energy that is convex.
        design: values in the order of the model's design space, shape (d,).
        loads: how the design changes with each load, shape (l, d). The first layer, which is linear, contains the
            scaling of the design and these directions.
        name: prefix.

    Raises:
        ValueError: if the scaled design does not depend linearly on loads, if the efforts' scale depends on them, or
            for weights that are not finite in single precision or of a robot at rest without load.
    """
    if "rest" in model.tensors:
        raise ValueError("the model is at rest without a load by construction, which bodies in C are not")
    points = np.vstack([design, design + loads, design + 2.0 * loads])
    features, context = model.features.design(points), model.context(points)
    base, first, second = features[0], *np.split(features[1:], 2)
    if not np.allclose(second - base, 2.0 * (first - base), rtol=0.0, atol=1e-9):
        raise ValueError("loads must change the scaled design linearly")
    if not np.allclose(context.stiffness, context.stiffness[0], rtol=1e-12):
        raise ValueError("loads must not change the scale of the efforts")
    e = model.passive
    layers = [(model.tensors[f"body.{k}.weight"], model.tensors[f"body.{k}.bias"]) for k in range(3)]
    (weight, bias), deep, last = ([part.astype(float) for part in layer] for layer in layers)
    width, outputs = weight.shape[1], sum(coefficient_sizes(model.count, e, model.width).values())
    sizes = sizes_of(model, e) | {"L": len(loads), "D": width, "O": outputs}
    constants = single_precision(
        network_constants(model, float(context.stiffness[0, 0]), e)
        | {
            "body_bias1": ("[M][D]", bias + weight @ base),
            "body1": ("[M][L][D]", (weight @ (first - base).T).swapaxes(1, 2)),
            "body_bias2": ("[M][D]", deep[1]),
            "body2": ("[M][D][D]", deep[0].swapaxes(1, 2)),
            "body_bias3": ("[M][O]", last[1]),
            "body3": ("[M][D][O]", last[0].swapaxes(1, 2)),
            "rest_mean": ("[E]", model.effector_mean),
            "rest_scale": ("", np.array(model.effector_scale / model.members)),
        },
        sizes,
    )
    letters = {letter: macro for letter, (macro, _) in _SIZES.items()}
    fields = (
        f"    float {key}{dimensions(shape, letters, name)};"
        for key, (shape, _) in body_constants(model, context, e).items()
    )
    names = names_of(name, many=True)
    parts = [
        macros(sizes, _SIZES, name),
        "",
        *definitions(constants, letters, name),
        "\ntypedef struct {",
        *fields,
        f"}} {name}_body; /* what the model depends on */\n",
        functions("bodies", names),
        functions("functions", names),
    ]
    return "\n".join(parts), 4 * sum(array.size for _, array in constants.values())
