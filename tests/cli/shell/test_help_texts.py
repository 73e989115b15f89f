"""Help texts are broken by the terminal, not where the lines of the source end."""

from __future__ import annotations

from naibu.cli.shell.help_texts import joined_lines

DOCSTRING = """Cut a mesh.

    A solid is cut along
    the path of a blade.

    Parameters
    ----------
    source
        A mesh, or
        a surface.
    out
        Folder.
    """


def test_paragraphs_are_a_line_each_and_sections_stay() -> None:
    expected = (
        "Cut a mesh.\n\nA solid is cut along the path of a blade.\n\nParameters\n----------\n"
        "source\n    A mesh, or a surface.\nout\n    Folder."
    )
    assert joined_lines(DOCSTRING) == expected
