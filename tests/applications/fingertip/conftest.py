"""Coarse models of a fingertip and a decoder, computed once."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.applications.fingertip.decoder import ForceDecoder, Training, train_decoder
from naibu.applications.fingertip.fingertip import Fingertip, FingertipResolution
from naibu.applications.fingertip.pressing import FingertipModel, Press, Pressing
from naibu.applications.fingertip.readings import ReadingChain
from naibu.applications.sensing_chip.electronics import report_readout

COARSE = FingertipResolution(2, 2, 8)


@pytest.fixture(scope="session")
def chain() -> ReadingChain:
    """The printed sensitivities, with a crosstalk of lateral forces of the size that finite elements of the chip give."""
    matrix = np.zeros((3, 6))
    matrix[0, 2], matrix[1, 3], matrix[2, 4], matrix[1, 1], matrix[2, 0] = 0.2, 2.83, 2.83, -0.006, 0.006
    return ReadingChain(matrix, report_readout())


@pytest.fixture(scope="session")
def coarse() -> FingertipModel:
    return FingertipModel.of(Fingertip(), COARSE)


@pytest.fixture(scope="session")
def tilted(coarse: FingertipModel) -> Pressing:
    return coarse.pressed(Press(20.0, 2000.0, friction=0.0))


@pytest.fixture(scope="session")
def training() -> Training:
    return Training((0.0, 10.0, 20.0, 32.0), (0.3, 1.0), (200.0, 240.0), (300.0, 2200.0), 0.05)


@pytest.fixture(scope="session")
def decoder(coarse: FingertipModel, chain: ReadingChain, training: Training) -> ForceDecoder:
    tip = coarse.fingertip
    return train_decoder(tip, chain, training, [coarse.pressed(press) for press in training.presses(tip)])
