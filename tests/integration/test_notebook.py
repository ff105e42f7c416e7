"""The notebook in examples/: its cells run, and end in a picture."""

import contextlib
import io
from pathlib import Path

import matplotlib
import nbformat
import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
NOTEBOOK = ROOT / "examples" / "two_scans.ipynb"

pytestmark = pytest.mark.numerical


@pytest.fixture(scope="module")
def notebook():
    found = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(found)
    return found


def test_it_is_kept_without_outputs(notebook):
    for cell in notebook.cells:
        if cell.cell_type == "code":
            assert cell.outputs == []
            assert cell.execution_count is None
    assert set(notebook.metadata) == {"kernelspec", "language_info"}


def test_its_cells_go_from_two_arrays_to_a_picture(notebook):
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    plt.close("all")
    names, said = {}, io.StringIO()
    with contextlib.redirect_stdout(said):
        for number, cell in enumerate(notebook.cells):
            if cell.cell_type == "code":
                exec(compile(cell.source, f"cell {number}", "exec"), names)
    # What the text between them says: another place for each point, and nearly the right one.
    assert names["before"].shape == (2000, 3)
    assert names["after"].shape == (2500, 3)
    assert names["error"].mean() < 0.4 * names["moved"].mean()
    assert "expected error" in said.getvalue().lower()
    (figure,) = map(plt.figure, plt.get_fignums())
    figure.canvas.draw()
    picture = np.asarray(figure.canvas.buffer_rgba())[..., :3]
    for half in np.array_split(picture, 2, axis=1):
        drawn = (half != 255).any(axis=2)
        assert 0.02 < drawn.mean() < 0.9
        assert len(np.unique(half[drawn], axis=0)) > 100  # colours, not grey text alone
    plt.close("all")
