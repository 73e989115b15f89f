"""A pair in Zarr is measured block by block within stated memory: resumed after a kill, the same on two workers as on one."""

from __future__ import annotations

import json
import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from worker_tasks import process_of_block

from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.imaging.large_volumes.block_sums import compared_block
from naibu.io.images import read_volume, write_volume
from naibu.validation.specimens.textured_sphere import squeezed_ball
from naibu.workflows.measurement import block_checkpoint
from naibu.workflows.measurement.block_checkpoint import BlockCheckpoint, StoredVolume
from naibu.workflows.measurement.sense import sense
from naibu.workflows.measurement.sense_blocks import CHECKPOINT, MemoryPlan, sense_blocks
from naibu.workflows.parallel import local_worker
from naibu.workflows.parallel.frames import write_frame
from naibu.workflows.parallel.worker_count import Workers
from naibu.workflows.parallel.worker_pool import WorkerPool

pytest.importorskip("zarr")
PLAN = MemoryPlan(1000.0, 500.0, 1, 24)


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("pair")
    before, after, _, _ = squeezed_ball(seed=1)
    return write_volume(folder / "before.zarr", before), write_volume(folder / "after.zarr", after)


def results(folder: Path) -> list[np.ndarray]:
    from naibu.io.image_formats.zarr_store import open_array

    return [np.asarray(open_array(folder / f"{name}.zarr")[:]) for name in ("displacement", "standard_deviation", "mask")]


@pytest.mark.slow
def test_a_killed_run_goes_on_and_two_workers_give_what_one_gives(
    pair: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent: list[int] = []

    def counted_frame(stream: Any, content: Any) -> None:
        sent.append(len(pickle.dumps(content)))
        write_frame(stream, content)

    monkeypatch.setattr(local_worker, "write_frame", counted_frame)
    whole = sense_blocks(*pair, out=tmp_path / "two", plan=PLAN, workers=2)
    assert len(sent) > 20 and max(sent) < 5_000  # paths and a box: arrays lie in files, which a worker reads once a pass
    count = 0

    def counted(*arguments: Any) -> Any:
        nonlocal count
        count += 1
        if count == stop:
            raise KeyboardInterrupt
        return compared_block(*arguments)

    kept = block_checkpoint.kept_block

    def kept_here(*, function: Any, **rest: Any) -> None:
        kept(function=counted if function is compared_block else function, **rest)

    monkeypatch.setattr(block_checkpoint, "kept_block", kept_here)
    stop = 12
    with pytest.raises(KeyboardInterrupt):
        sense_blocks(*pair, out=tmp_path / "one", plan=PLAN)
    with pytest.raises(InputError, match="resume"):
        sense_blocks(*pair, out=tmp_path / "one", plan=PLAN)
    before, stop = count, 0
    run = sense_blocks(*pair, out=tmp_path / "one", plan=PLAN, resume=True)
    blocks, passes = (run.measured.facts[name] for name in ("blocks", "passes"))
    # the blocks before the kill are not computed again, but for the one that was lost; the probe of the noise has some more
    assert blocks * passes < count - 1 < blocks * passes + 14
    assert before == 12
    for a, b in zip(results(tmp_path / "one"), results(tmp_path / "two"), strict=True):
        # sums of other threads differ in the last digit of single precision
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=2e-6)
    assert not (tmp_path / "one" / CHECKPOINT).exists()
    told = json.loads((tmp_path / "one" / "sense.json").read_text())
    assert told["diagnostics"]["blocks"] == blocks == whole.measured.facts["blocks"]
    # what is written is the truth, within a few standard deviations
    u, sd, mask = results(tmp_path / "one")
    _, _, truth, _ = squeezed_ball(seed=1)
    error = np.linalg.norm(u - truth, axis=-1)[mask > 0]
    assert np.median(error) < 0.15
    assert np.mean(error < 3.0 * sd[mask > 0]) > 0.9
    assert read_volume(tmp_path / "one" / "mask.zarr").values.sum() == mask.sum()


def test_memory_decides_whether_a_pair_is_measured_block_by_block() -> None:
    assert not MemoryPlan.of((100, 100, 100), 4.0).by_blocks
    large = MemoryPlan.of((512, 512, 512), 4.0)
    assert large.by_blocks
    assert large.needed_mb > 40_000
    assert "block by block" in large.told()
    assert MemoryPlan.of((512, 512, 512), 1.0).edge < large.edge
    with pytest.raises(InputError, match="memory_gb"):
        MemoryPlan.of((512, 512, 512), 0.2)


@pytest.mark.parametrize("processes", [1, 4])
def test_too_little_memory_is_told_with_what_suffices(processes: int) -> None:
    shape = (200, 200, 200)
    with pytest.raises(InputError, match="too little") as refused:
        MemoryPlan.of(shape, 0.2, processes)
    told = str(refused.value)
    assert ("fewer `workers`" in told) == (processes > 1)
    found = re.search(r"give at least ([\d.]+)", told)
    assert found is not None
    least = float(found[1])
    assert MemoryPlan.of(shape, least, processes).edge >= 32
    with pytest.raises(InputError, match="too little"):
        MemoryPlan.of(shape, 0.9 * least, processes)


def test_nothing_is_resumed_where_there_is_nothing(pair: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nothing to resume"):
        sense_blocks(*pair, out=tmp_path, plan=PLAN, resume=True)


def test_processes_stay_from_one_pass_to_the_next(pair: tuple[Path, Path], tmp_path: Path) -> None:
    volumes = StoredVolume(str(pair[0])), StoredVolume(str(pair[1])), None
    with WorkerPool() as pool:
        kept = BlockCheckpoint(tmp_path / "kept", volumes, Workers(2), pool, 100.0, None)
        kept.begin({}, {}, resume=False, overwrite=False)
        first, second = (list(kept.each(name, process_of_block, (), range(4))) for name in ("first", "second"))
        again = list(kept.each("second", process_of_block, (), range(4)))  # as after an interruption
    assert [item for item, _ in first] == [item for item, _ in second] == [0, 1, 2, 3]
    assert {pid for _, pid in first} == {pid for _, pid in second} and len({pid for _, pid in first}) == 2
    assert again == second


def test_what_is_refused_before_the_first_pass_leaves_nothing_to_resume(pair: tuple[Path, Path], tmp_path: Path) -> None:
    before = read_volume(pair[0])
    flat = write_volume(tmp_path / "flat.zarr", before.with_values(np.full(before.shape, 7.0)))
    for _ in range(2):
        with pytest.raises(InputError, match="deformed"):
            sense_blocks(pair[0], flat, out=tmp_path / "out", plan=PLAN)
        assert not (tmp_path / "out" / CHECKPOINT).exists()


def test_blocks_of_other_code_are_not_resumed(pair: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A version number does not change with every edit, and sums of two programs add up to nothing."""

    def stopped(**_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(block_checkpoint, "kept_block", stopped)
    with pytest.raises(KeyboardInterrupt):
        sense_blocks(*pair, out=tmp_path / "out", plan=PLAN)
    monkeypatch.setattr(block_checkpoint, "_digest_of_code", lambda: "of an earlier program")
    with pytest.raises(InputError, match="another version of naibu"):
        sense_blocks(*pair, out=tmp_path / "out", plan=PLAN, resume=True)


def test_a_deformed_scan_on_another_grid_is_resampled_by_blocks_as_in_memory(pair: tuple[Path, Path], tmp_path: Path) -> None:
    after = read_volume(pair[1])
    cropped = Volume(after.values[2:, 1:, :-2].copy(), after.spacing_mm, after.to_physical([0, 1, 2]), after.direction)
    moved = write_volume(tmp_path / "cropped.zarr", cropped)
    mask = write_volume(tmp_path / "mask.zarr", cropped.with_values(np.ones(cropped.shape, dtype=np.uint8)))
    run = sense_blocks(pair[0], moved, deformed_mask=mask, out=tmp_path / "blocks", plan=PLAN)
    assert any("another grid" in warning for warning in run.measured.warnings)
    there = sense(pair[0], moved, deformed_mask=mask)
    by_blocks, in_memory = results(tmp_path / "blocks")[0], there.measured.displacement.vectors
    answered = np.isfinite(in_memory)
    assert np.isfinite(by_blocks[answered]).mean() > 0.99
    assert np.nanmean(np.abs(by_blocks - in_memory)[answered]) < 0.02 * after.spacing_mm.min()


def test_masks_beside_the_deformed_grid_and_contradicting_grids_are_refused_before_anything_is_written(
    pair: tuple[Path, Path], tmp_path: Path
) -> None:
    after = read_volume(pair[1])
    other = Volume(after.values[2:], after.spacing_mm, after.origin_mm, after.direction)
    with pytest.raises(InputError, match="deformed_mask does not lie on the grid of deformed"):
        sense_blocks(*pair, deformed_mask=write_volume(tmp_path / "mask.zarr", other), out=tmp_path / "out", plan=PLAN)
    coarser = write_volume(tmp_path / "coarser.zarr", Volume(after.values, 1.1 * after.spacing_mm, after.origin_mm, after.direction))
    with pytest.raises(InputError, match="as many voxels, but"):
        sense_blocks(pair[0], coarser, out=tmp_path / "out", plan=PLAN)
    assert not (tmp_path / "out").exists()
