"""What several verbs take to describe an object: layers and stated heights, as texts."""

from __future__ import annotations

from collections.abc import Sequence

from naibu.core.errors import InputError
from naibu.core.experiment import Layer


def layers_of(texts: Sequence[str]) -> tuple[Layer, ...]:
    """Return layers from texts such as ``hardness 0=0..30``, heights from the base in mm.

    Raises
    ------
    InputError
        A text of another form.
    """
    layers = []
    for text in texts:
        material, _, span = text.rpartition("=")
        low, dots, high = span.partition("..")
        try:
            if not (material.strip() and dots):
                raise ValueError
            layers.append(Layer(material.strip(), float(low), float(high)))
        except ValueError:
            raise InputError(
                f"--layer {text!r} must be NAME=FROM..TO with heights from the base in mm, such as 'hardness 0=0..30'"
            ) from None
    return tuple(layers)


def heights_of(texts: Sequence[str]) -> dict[str, float]:
    """Return heights by state from texts such as ``pressed=45``, mm.

    Raises
    ------
    InputError
        A text of another form.
    """
    heights = {}
    for text in texts:
        state, _, height = text.rpartition("=")
        try:
            if not state.strip():
                raise ValueError
            heights[state.strip()] = float(height)
        except ValueError:
            raise InputError(f"--stated-mm {text!r} must be STATE=HEIGHT in mm, such as 'pressed=45'") from None
    return heights
