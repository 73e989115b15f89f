"""The Harris operator: at known corners, not along edges, the same on voxels of any shape."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import grid, inner, texture

from naibu.core.errors import InputError
from naibu.core.rigid_transform import rotation_matrix
from naibu.core.volume import Volume
from naibu.imaging.feature_matching.harris import harris_response, interest_points
from naibu.imaging.preprocessing.resampling import positions


def smooth_step(x: np.ndarray) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(-x / 0.25))


def box(frame: Volume, low: np.ndarray, high: np.ndarray) -> Volume:
    x = positions(frame)
    axes = range(3) if frame.shape[0] > 1 else range(2)
    values = np.prod([smooth_step(x[..., a] - low[a]) * smooth_step(high[a] - x[..., a]) for a in axes], axis=0)
    return frame.with_values(1000.0 * values)


@pytest.mark.parametrize("response", ["ratio", "harris"])
@pytest.mark.parametrize("shape", [(30, 36, 40), (1, 36, 40)])
def test_the_corners_of_a_box_are_found(shape: tuple[int, int, int], response: str) -> None:
    frame = Volume.from_array(np.zeros(shape), spacing_mm=(1.0, 1.0, 1.0))
    low, high = np.array([9.0, 8.0, 7.0]), np.array([29.0, 27.0, 22.0])
    d = 3 if shape[0] > 1 else 2
    found = interest_points(box(frame, low, high), count=2**d, response=response, k=0.04, min_distance_mm=4.0)
    corners = np.stack(np.meshgrid(*zip(low[:d], high[:d], strict=True), indexing="ij"), axis=-1).reshape(-1, d)
    distance = np.linalg.norm(found.points_mm[:, None, :d] - corners, axis=-1)
    assert len(found) == 2**d
    assert distance.min(axis=0).max() < 1.8
    assert sorted(distance.argmin(axis=0)) == list(range(2**d))


def test_edges_and_faces_respond_less_than_corners() -> None:
    frame = Volume.from_array(np.zeros((30, 30, 30)), spacing_mm=(1.0, 1.0, 1.0))
    response = harris_response(box(frame, np.full(3, 9.0), np.full(3, 21.0)))
    corner, edge, face = response[8:11, 8:11, 8:11].max(), response[14:16, 8:11, 8:11].max(), response[14:16, 14:16, 8:11].max()
    assert edge < 0.05 * corner and face < 0.01 * corner


def test_the_response_is_that_of_the_formula() -> None:
    rng = np.random.default_rng(0)
    volume = Volume.from_array(rng.uniform(0, 50, (7, 8, 9)), spacing_mm=(0.8, 1.0, 2.0))
    found = harris_response(volume, response="harris", k=0.05, gradient_sigma_mm=0.0, window_sigma_mm=0.0)
    slopes = [np.gradient(volume.values, volume.spacing_mm[a], axis=2 - a) for a in range(3)]
    m = np.einsum("azyx,bzyx->zyxab", slopes, slopes)
    # without a window M has rank one: det M = 0
    np.testing.assert_allclose(found, -0.05 * np.trace(m, axis1=-2, axis2=-1) ** 2, rtol=2e-3, atol=0.5)


def test_voxels_of_any_shape_give_the_same_response() -> None:
    intensity = texture(2, (8.0, 16.0))
    options = {"gradient_sigma_mm": 1.5, "window_sigma_mm": 3.0}
    fine = Volume.from_array(np.zeros((40, 40, 40)), spacing_mm=(1.0, 1.0, 1.0))
    thick = Volume.from_array(np.zeros((20, 40, 40)), spacing_mm=(1.0, 1.0, 2.0))
    a, b = (harris_response(v.with_values(intensity(positions(v))), **options) for v in (fine, thick))
    inside = inner((20, 40, 40), 5)
    relative = np.abs(a[::2][inside] - b[inside]).max() / a[::2][inside].max()
    assert relative < 0.15


def test_points_keep_their_distance_their_number_and_their_mask() -> None:
    frame = grid((20, 30, 40), (1.0, 1.2, 2.0), rotation_matrix(np.array([0.1, 0.5, -0.3])))
    volume = frame.with_values(texture(1)(positions(frame)))
    found = interest_points(volume, min_distance_mm=4.0, border=(3, 2, 1))
    apart = np.linalg.norm(found.points_mm[:, None] - found.points_mm, axis=-1)
    np.fill_diagonal(apart, np.inf)
    assert apart.min() > 4.0
    assert (np.diff(found.responses) <= 0).all()
    assert (found.indices >= [3, 2, 1]).all() and (found.indices < np.array([40, 30, 20]) - [3, 2, 1]).all()
    np.testing.assert_allclose(volume.to_physical(found.indices), found.points_mm)
    fewer = interest_points(volume, count=10, min_distance_mm=4.0, border=(3, 2, 1))
    np.testing.assert_array_equal(fewer.indices, found.indices[:10])
    mask = np.zeros(frame.shape, dtype=bool)
    mask[:, :, 20:] = True
    assert (interest_points(volume, mask=mask).indices[:, 0] >= 20).all()
    strong = interest_points(volume, threshold=float(np.median(found.responses)), min_distance_mm=4.0, border=(3, 2, 1))
    np.testing.assert_array_equal(strong.indices, found.indices[: len(strong)])


def test_greedy_thinning_is_that_of_a_double_loop() -> None:
    frame = grid((12, 20, 24))
    volume = frame.with_values(texture(4, (3.0, 6.0))(positions(frame)))
    everything = interest_points(volume, min_distance_mm=0.0)
    kept: list[int] = []
    for i, p in enumerate(everything.points_mm):
        if all(np.linalg.norm(p - everything.points_mm[j]) > 5.0 for j in kept):
            kept.append(i)
    np.testing.assert_array_equal(interest_points(volume, min_distance_mm=5.0).indices, everything.indices[kept])


def test_what_has_no_points_is_refused() -> None:
    frame = grid((6, 7, 8))
    with pytest.raises(InputError, match="constant"):
        interest_points(frame)
    textured = frame.with_values(texture()(positions(frame)))
    with pytest.raises(InputError, match="lower the threshold"):
        interest_points(textured, threshold=1e12)
    with pytest.raises(InputError, match="count must be one or more"):
        interest_points(textured, count=0)
    for arguments, words in (
        ({"min_distance_mm": -1.0}, "min_distance_mm must be 0 or more"),
        ({"border": (1, -1, 0)}, "border must be 0 or more"),
        ({"gradient_sigma_mm": -0.1}, "gradient_sigma_mm must be"),
        ({"window_sigma_mm": np.inf}, "window_sigma_mm must be"),
    ):
        with pytest.raises(InputError, match=words):
            interest_points(textured, **arguments)
    with pytest.raises(InputError, match="response must be"):
        harris_response(textured, response="fast")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="unknown voxels"):
        harris_response(frame.with_values(np.full(frame.shape, np.nan)))
