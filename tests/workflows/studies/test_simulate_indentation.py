"""Studies of indentations as files: what they write, and which ones are refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkIOHDF import vtkHDFReader

from naibu.core.errors import InputError
from naibu.io.vtk_files import write_vtu
from naibu.meshing.primitives import box
from naibu.workflows.studies.indentation_study import describes_indentation, prepared_indentation
from naibu.workflows.studies.simulate import example_text, named_studies, simulate

SMALL = {
    "max_unknowns = 20000": "max_unknowns = 700",
    "steps = 8 ": "steps = 2 ",
    "element_mm = 10.0 ": "element_mm = 20.0 ",
    "poisson_ratio = 0.45 ": "poisson_ratio = 0.3 ",
}
SECOND = "[[indenter]]\nshape = 'sphere'\nradius_mm = 1.0\nname = 'sphere'\ncentre_mm = [5, 5, 42]\ntravel_mm = [0, 0, -2]\n"


def written(folder: Path, changes: dict[str, str]) -> Path:
    text = example_text("indentation")
    for old, new in changes.items():
        assert old in text, old
        text = text.replace(old, new, 1)
    path = folder / "my_gel.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_study_is_written_as_page_numbers_and_motion(tmp_path: Path) -> None:
    heard = []
    study = written(tmp_path, SMALL | {"friction = 0.0 ": "friction = 0.3 "})
    run = simulate(study, out=tmp_path / "out", progress=lambda report: heard.append(report.done / report.total))
    page, numbers, series = run.files
    assert run.finished and heard and max(heard) <= 1.0
    told = json.loads(numbers.read_text(encoding="utf-8"))
    force, error, better = (np.array(told[k]["sphere"]) for k in ("forces_mN", "estimated_errors_mN", "corrected_forces_mN"))
    assert better == pytest.approx(force - error) and force[-1, 2] < better[-1, 2] < 0.0
    assert told["travel_mm"] == pytest.approx([0.0, 2.0, 4.0]) and len(told["meshes"]) > 1
    text = page.read_text(encoding="utf-8")
    assert "travel (mm)" in text and "Not reached: the estimated error of the forces" in text and "With friction" in text
    reader = vtkHDFReader()
    reader.SetFileName(str(series))
    reader.SetStep(2)
    reader.Update()
    assert reader.GetOutput().GetNumberOfCells() == told["tetrahedra"]
    assert vtk_to_numpy(reader.GetOutput().GetPointData().GetArray("displacement_mm")).shape == (told["nodes"], 3)


def test_regions_of_a_mesh_have_their_own_materials(tmp_path: Path) -> None:
    mesh = box((60, 60, 40), (3, 3, 2), layers=[("soft", 20.0), ("stiff", 20.0)], centred=False, cell_type="tetra")
    write_vtu(tmp_path / "body.vtu", mesh)
    stiff, soft = '[[material]]\nregion = "stiff"\nyoung_modulus_kPa = 40.0\n', '[[material]]\nregion = "soft"\nyoung_modulus_kPa = 5.0\n'
    changes = {
        "size_mm = [60, 60, 40] ": 'mesh = "body.vtu" #',
        "element_mm = 10.0 ": "# ",
        "[[material]] ": f"{stiff}{soft}#",
        'law = "neo_hookean" ': "# ",
        "young_modulus_kPa = 20.0\n": "",
        "poisson_ratio = 0.45 ": "# ",
        'shape = "sphere" ': 'shape = "bar" ',
        "radius_mm = 8.0": "radius_mm = 5.0\nlength_mm = 30",
    }
    study = prepared_indentation(written(tmp_path, changes))
    assert [m.small_strain_shear_modulus for m in study.materials] == pytest.approx([5.0 / 2.9, 40.0 / 2.9])
    assert study.locks and study.indenters[0].geometry.name == "capsule" and "body.vtu" in study.inputs
    with pytest.raises(InputError, match="region 'soft' of the mesh has no material"):
        prepared_indentation(written(tmp_path, changes | {"[[material]] ": f"{stiff}#"}))
    with pytest.raises(InputError, match="is no region of the mesh; it has soft, stiff"):
        prepared_indentation(written(tmp_path, changes | {"[[material]] ": stiff + soft.replace("soft", "hard") + "#"}))


def test_the_study_that_comes_along_is_listed_and_is_its_example() -> None:
    assert any(s.name == "indentation" and s.model == "adaptive finite elements" for s in named_studies())
    assert describes_indentation("indentation") and not describes_indentation("chip") and not describes_indentation("nowhere.toml")
    assert prepared_indentation("indentation").indenters[0].gap(prepared_indentation("indentation").mesh.points).min() == pytest.approx(0.0)


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"size_mm = [60, 60, 40] ": "size_mm = [60, 60, -40] "}, r"\[solid\] size_mm"),
        ({"size_mm = [60, 60, 40] ": "#"}, r"give size_mm, the edges of a block, or mesh"),
        ({"element_mm = 10.0 ": "element_mm = 0.01 "}, "more than 200000 tetrahedra"),
        ({"held_below_mm = 0.0 ": "held_below_mm = 50.0 "}, "holds the whole solid"),
        ({"poisson_ratio = 0.45 ": "poisson_ratio = 0.5 "}, r"\[\[material\]\] number 1 poisson_ratio = 0.5"),
        ({"radius_mm = 8.0": ""}, "a sphere has radius_mm; add radius_mm"),
        ({"centre_mm = [30.0, 30.0, 48.0]": "centre_mm = [30.0, 30.0, 45.0]"}, "begins 3 mm inside the solid"),
        ({"travel_mm = [0.0, 0.0, -4.0]": "travel_mm = [0.0, 0.0, 4.0]"}, r"\[\[indenter\]\] number 1 does not press into the body"),
        ({"travel_mm": "travel"}, r"\[\[indenter\]\] number 1 travel is not a known key; did you mean 'travel_mm'"),
        ({"tolerance = 0.1 ": "tolerance = 0.0 "}, r"\[refinement\] tolerance = 0.0"),
        ({"[[indenter]] ": f"{SECOND}[[indenter]] "}, "is given twice"),
    ],
)  # fmt: skip
def test_bad_studies_are_refused_and_nothing_is_written(changes: dict[str, str], what: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=what):
        simulate(written(tmp_path, SMALL | changes if not set(SMALL) & set(changes) else changes), out=tmp_path / "out")
    assert not list((tmp_path / "out").glob("*.*")) if (tmp_path / "out").exists() else True
