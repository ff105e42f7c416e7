"""What the page of a registration says, and in which words."""

from dataclasses import replace

import numpy as np
import pytest

from dine.data.synthetic import primitive
from dine.geometry.frame import Frame
from dine.geometry.rigid import Alignment
from dine.geometry.surface import Surface
from dine.registration.assessment import DOUBTFUL, GOOD, IMPLAUSIBLE
from dine.registration.page import view_of
from dine.registration.types import RegistrationResult, Trust
from dine.viewer.view import write_view

SOURCE = primitive(0, 0)
ERROR = np.linspace(1, 3, len(SOURCE.vertices))


def registered(*, verdict=GOOD, organ=False, partial=False, hd95=12.0):
    report = {
        "before": {"hd95": hd95},
        "after": {"hd95": 1.9},
        "displacement": {"max": 12345.6},
        "folding": 0.01,
        "backbone": None if organ else "robust_defreg",
        "seconds": 2.0,
        "settings": {"partial": partial},
    }
    return RegistrationResult(
        Surface(SOURCE.vertices, SOURCE.faces, name="a/before.ply"),
        Surface(SOURCE.vertices + 1, name="b/after.ply"),
        Surface(SOURCE.vertices + 1, SOURCE.faces),
        np.ones_like(SOURCE.vertices),
        ERROR,
        {},
        *(SOURCE.vertices, np.ones_like(SOURCE.vertices), ERROR, ERROR > 0),
        Trust(verdict, ("A reason.",), {}, 2.0),
        report,
        alignment=None,
        motion=None,
        bound=3 * ERROR if organ else None,
    )


def shown(*, organ=False, **facts):
    result = registered(organ=organ, **facts)
    scalars = {"displacement": ERROR, "distance to target": ERROR, "expected error": ERROR}
    return view_of(result, SOURCE, scalars | ({"bound 90": 3 * ERROR} if organ else {}))


def test_lengths_are_in_one_unit():
    view = shown()
    assert view.title == "before.ply → after.ply"
    assert set(view.units) == set(view.scalars)
    assert set(view.units.values()) == {view.unit} == {"units of the files"}
    assert view.facts["HD95"] == "12.0 → 1.90"
    assert shown(hd95=123.4).facts["HD95"] == "123 → 1.90"
    assert view.facts["Largest displacement"] == "12,346"
    assert view.facts["Expected error"] == "2.00"


@pytest.mark.parametrize("verdict", [GOOD, DOUBTFUL, IMPLAUSIBLE])
@pytest.mark.parametrize("organ", [False, True])
def test_numbers_are_explained(verdict, organ, tmp_path):
    view = shown(verdict=verdict, organ=organ)
    assert (view.verdict, tuple(view.reasons)) == (verdict, ("A reason.",))
    plain = {"Network", "Time"}
    assert (set(view.facts) - plain) | set(view.scalars) | {"verdict"} <= set(view.explained)
    assert all(view.explained.values())
    write_view(tmp_path / "a.html", view)
    page = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert view.explained["verdict"] in page
    assert view.explained["HD95"] in page


def test_what_a_prior_of_an_organ_gives_has_its_own_names():
    view = shown(organ=True)
    assert list(view.scalars)[2:] == ["posterior deviation", "90 % bound"]
    np.testing.assert_array_equal(view.scalars["posterior deviation"], ERROR)
    assert view.facts["Posterior deviation"] == "2.00"
    assert view.facts["90 % bound"] == "6.00"
    assert "Expected error" not in view.facts
    assert "posterior deviation" not in shown().scalars


def test_further_shapes_start_where_the_source_does():
    frame = Frame.of(SOURCE.vertices)
    turn = np.array([[0.0, -1, 0, 5], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    tumour = Surface(SOURCE.vertices[:9] + 3, name="tumour.ply")
    result = replace(
        registered(),
        alignment=Alignment(turn, frame),
        applied={"tumour": tumour},
        applied_from={"tumour": SOURCE.vertices[:9]},
    )
    before, after = view_of(result, SOURCE, {}).further["tumour"]
    x, y, z = SOURCE.vertices[:9].T
    np.testing.assert_allclose(before.vertices, np.stack([5 - y, x, z], axis=1))
    np.testing.assert_array_equal(after, tumour.vertices)
    # Kept by an earlier version, which did not say where it was.
    assert view_of(replace(result, applied_from={}), SOURCE, {}).further == {}


def test_partial_distances_count_from_the_target():
    assert shown(partial=True).explained["HD95"] != shown().explained["HD95"]
