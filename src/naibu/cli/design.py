"""Verb ``design``: how well a planned experiment will tell moduli."""

from __future__ import annotations

from pathlib import Path

from naibu.cli.shell.console import print_table, progress_display, say
from naibu.cli.shell.described import Flag, Known, Layers, Out, Overwrite, Whole, labels_of, layers_of
from naibu.cli.shell.run_record import wrote
from naibu.cli.shell.verbs import START, verb


@verb(
    START,
    "design --size-mm 40 40 40 -l gel=0..20 -l pad=20..40 -k 'pad=10 kPa' --expect 'gel=5 kPa' --push z+=0,0,-3 --plates-only",
    "design --zones labels.mha --zone-name gel=1 --zone-name pad=2 -k 'pad=10 kPa' --expect 'gel=5 kPa' --push z+=0,0,-3 --push z+=3,0,0",
)
def design(
    *,
    zones: Path | None = None,
    zone_name: list[str] | None = None,
    size_mm: tuple[float, float, float] | None = None,
    layer: Layers = None,
    known: Known = None,
    expect: list[str] | None = None,
    push: list[str] | None = None,
    points: list[Whole] | None = None,
    noise_mm: list[float] | None = None,
    plates_only: Flag = False,
    element_size_mm: float = 0.0,
    out: Out = Path("naibu-design"),
    overwrite: Overwrite = False,
) -> None:
    """Plan an experiment: how well moduli will be known, by push, number of measured points or markers, and noise.

    Every combination of push, number of points and noise is tried, and all pushes together. Nothing is measured: the displacement is
    simulated with the moduli that are expected, and identified with the noise to come.

    Parameters
    ----------
    zones
        Volume of labels of the object, one for each material, 0 outside; or give a box by --size-mm.
    zone_name
        Name of a label, 'gel=1' or '1=gel'. May be repeated.
    size_mm
        Sides of a box along x, y and z.
    layer
        Of a box: a layer of one material, 'NAME=FROM..TO' with heights from the base in mm. May be repeated.
    known
        A material whose Young's modulus will be known, 'pad=10 kPa', or 'pad=10 kPa, 0.45' with Poisson's ratio. May be repeated.
    expect
        What the moduli of another material may be, 'gel=5 kPa, 0.45'. May be repeated.
    push
        A side and its displacement in mm, 'z+=0,0,-3'; the opposite side is held, and both stick. May be repeated.
    points
        Number of measured points: markers, or independent vectors of a field; 400 by default. May be repeated.
    noise_mm
        Standard deviation of a component of a measured displacement, mm; 0.1 by default. May be repeated.
    plates_only
        Nothing but the plates of a push touches the object; without it forces may act on the whole surface, as naibu identify takes it.
    element_size_mm
        Edge length of the elements; 0 selects it automatically.
    out
        Folder for design.html and design.json.
    overwrite
        Replace results, or files of your own, that the folder already holds.
    """
    from naibu.workflows.fields.design import design as run

    with progress_display() as progress:
        result = run(
            zones, size_mm=size_mm, layers=layers_of(layer or ()), zone_names=labels_of(zone_name or ()), known=known or (),
            expected=expect or (), pushes=push or (), points=points or (400,), noise_mm=noise_mm or (0.1,),
            plates_only=plates_only, element_size_mm=element_size_mm, out=out, overwrite=overwrite, progress=progress,
        )  # fmt: skip
    for number, line in enumerate(result.notes):
        say(line, "bold" if number == 0 else "dim")
    table = result.table()
    print_table(table.title, table.columns, table.rows, digits=3)
    wrote(*result.files)
    say(f"Page: {out / 'design.html'}   numbers: {out / 'design.json'}")
