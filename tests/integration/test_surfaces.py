"""Refinement against surfaces: on what is known to be the answer, and within registrations."""

import dataclasses
import functools
from pathlib import Path

import numpy as np
import pytest
import trimesh
from click.testing import CliRunner

import dine
from dine.cli import cli
from dine.data.sampling import sample_surface
from dine.errors import DineError
from dine.files import read_json
from dine.geometry.oriented import Curve, OrientedPoints, evenly
from dine.geometry.rigid import Alignment
from dine.geometry.surface import Surface
from dine.io.readers import read_surface
from dine.io.writers import write_surface
from dine.refinement.process import FINER, SURFACE
from dine.refinement.surface import Outline, SurfaceOptions, refine_on_surface
from dine.registration import overlap
from dine.registration.assessment import mirrored
from dine.registration.surfaces import FULL, oriented_points
from dine.registration.types import Correspondence, Model, Overlap, Pair, Settings

pytestmark = pytest.mark.numerical
NO_CURVE = Curve(np.zeros((0, 3)), np.zeros((0, 3)))


def organ(degrees=0.0, subdivisions=4):
    """A lopsided closed shape of about unit radius; its vertices lie elsewhere by degrees."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    turn = trimesh.transformations.rotation_matrix(np.radians(degrees), [1, 2, 3])[:3, :3]
    vertices = np.asarray(ball.vertices) @ turn
    reach = np.ones(len(vertices))
    for direction, height, width in (
        ((1, 0.3, 0.2), 0.9, 0.35), ((-0.4, 1, 0.1), 0.5, 0.3),
        ((0.1, -0.6, 1), 0.7, 0.25), ((-0.7, -0.5, -0.6), -0.35, 0.5),
    ):  # fmt: skip
        along = vertices @ (np.array(direction) / np.linalg.norm(direction))
        reach += height * np.exp(-(1 - along) / width**2)
    return Surface(vertices * reach[:, None] * [0.6, 0.5, 0.4], np.asarray(ball.faces))


def bent(points):
    """A smooth motion of some 10 % of the radius."""
    x, y, z = points.T
    return points + 0.1 * np.column_stack([np.sin(2 * y), np.cos(2 * z) - 1, np.sin(1.5 * x + 1)])


@pytest.fixture(scope="module")
def pair():
    """A source, and a target of other vertices with the places of the source's on it."""
    source, other = organ(), organ(50)
    return source, Surface(bent(other.vertices), other.faces), bent(source.vertices)


def mean_error(points, truth):
    return np.linalg.norm(points - truth, axis=1).mean()


def test_normals_of_a_mesh_point_out_of_it():
    found = oriented_points(organ(), 500, np.random.default_rng(0))
    assert np.allclose(np.linalg.norm(found.normals, axis=1), 1)
    assert ((found.normals * found.points).sum(axis=1) > 0).mean() > 0.98


def test_the_surface_says_more_than_its_points(pair):
    source, target, truth = pair
    coarse = dine.register(source, target, prealign="off", surfaces=False)
    fine = dine.register(source, target, prealign="off")
    assert mean_error(fine.moved.vertices, truth) < 0.02
    assert mean_error(fine.moved.vertices, truth) < 0.5 * mean_error(coarse.moved.vertices, truth)
    used = [result.report["settings"]["surfaces"] for result in (fine, coarse)]
    assert used == [True, False]


def test_a_mesh_registered_to_itself_stays_where_it_is():
    source = organ()
    result = dine.register(source, source)
    assert result.report["trust"]["checks"]["remaining"] == 0
    assert np.linalg.norm(result.displacement, axis=1).mean() < 1e-3


def test_clouds_use_all_their_points(pair):
    source, target, truth = pair
    rng = np.random.default_rng(0)
    drawn = sample_surface(target, 6000, rng).places(target.vertices)
    result = dine.register(source.vertices, drawn, prealign="off")
    assert mean_error(result.moved.vertices, truth) < 0.03


def test_a_part_of_the_target_pulls_at_what_it_shows_only(pair):
    source, target, truth = pair
    shown = target.vertices[target.vertices[:, 0] > -0.1]
    settings = {"prealign": "off", "partial": True}
    coarse = dine.register(source, shown, **settings, surfaces=False)
    fine = dine.register(source, shown, **settings)
    assert mean_error(fine.moved.vertices, truth) < mean_error(coarse.moved.vertices, truth)


def cut(surface, kept):
    """The faces (F,) alone, and the vertices that remain."""
    used, index = np.unique(surface.faces[kept], return_inverse=True)
    return Surface(surface.vertices[used], index.reshape(-1, 3)), used


@pytest.fixture(scope="module")
def overlapping(pair):
    """Parts of both, each without a fifth of the other's, turned; where the source's vertices
    belong, and which of them the target shows."""
    source, target, truth = pair
    along, there = (x.vertices[x.faces].mean(axis=1)[:, 0] for x in (source, target))
    ours, used = cut(source, along < np.quantile(along, 0.8))
    theirs, _ = cut(target, there > np.quantile(there, 0.2))
    seen = truth[used, 0] > theirs.vertices[:, 0].min()
    turn = trimesh.transformations.rotation_matrix(np.radians(35), [0.2, 1, 0.4], [1, 2, 0])
    turned = Surface(theirs.vertices @ turn[:3, :3].T + turn[:3, 3], theirs.faces)
    return ours, turned, truth[used] @ turn[:3, :3].T + turn[:3, 3], seen


@pytest.mark.parametrize("overlap", ["auto", "both"])
def test_parts_that_overlap_come_to_lie_on_each_other(overlapping, overlap):
    source, target, truth, seen = overlapping
    result = dine.register(source, target, overlap=overlap)
    assert mean_error(result.moved.vertices[seen], truth[seen]) < 0.03
    assert 0.6 < result.report["supported"] < 0.9
    assert "no counterpart" in " ".join(result.trust.reasons)
    assert result.report["settings"]["overlap"] == overlap
    assert result.report["overlap_found"] == "both"
    # Where the target shows nothing, more is left open; and only there is it much.
    shown = result.supported
    open_there = result.point_uncertainty[~shown].mean()
    assert open_there > 1.5 * result.point_uncertainty[shown].mean()
    # Without a rigid alignment the field itself turns, more than any that was validated on.
    assert result.trust.verdict == ("plausible" if overlap == "auto" else "doubtful")
    assert ("registered as parts" in " ".join(result.trust.reasons)) == (overlap == "auto")
    assert "mirror image" not in " ".join(result.trust.reasons)


@pytest.mark.parametrize(
    ("shown", "unmet", "of_closed", "of_open"),
    [
        ((1.0, 0.8), 0.02, False, True),  # a hole, or a part
        ((0.99, 1.0), 0.01, False, False),  # the rim of a face
        ((0.96, 0.97), 0.02, True, True),
        ((1.0, 1.0), 0.12, True, True),
        ((1.0, 1.0), None, False, False),
    ],
)
def test_parts_are_looked_for_where_something_is_lacking(shown, unmet, of_closed, of_open, pair):
    points = np.zeros((1, 3))
    found = Correspondence(points, points, points, None, np.ones(1, bool))
    found = dataclasses.replace(found, shown=shown, unmet=unmet)
    half, _ = cut(pair[0], pair[0].vertices[pair[0].faces[:, 0], 0] > 0)
    for target, parts in ((pair[1], of_closed), (half, of_open)):
        scans = Pair(pair[0], target, None, points, points, points)
        assert overlap.lacks(scans, found) == parts


@pytest.mark.parametrize(
    ("axis", "share", "part"), [(0, 0.8, "source"), (0, 0.8, "target"), (1, 0.6, "target")]
)
def test_auto_finds_where_a_part_lies_in_a_whole(axis, share, part):
    """By their middles and axes they would be laid on each other turned or shifted."""
    source, other = organ(), organ(40.0)
    target = Surface(bent(other.vertices), other.faces)
    truth = bent(source.vertices)
    whole = source if part == "source" else other
    along = whole.vertices[whole.faces].mean(axis=1)[:, axis]
    kept = along < np.quantile(along, share)
    seen = source.vertices[:, axis] < np.quantile(along, share)
    if part == "source":
        source, used = cut(source, kept)
        truth, seen = truth[used], seen[used]
    else:
        target, _ = cut(target, kept)
    result = dine.register(source, target)
    assert mean_error(result.moved.vertices[seen], truth[seen]) < 0.03
    assert result.report["overlap_found"] == "both"
    assert "mirror image" not in " ".join(result.trust.reasons)


def test_a_source_that_is_a_part_of_its_target(pair):
    source, target, truth = pair
    along = source.vertices[source.faces].mean(axis=1)[:, 0]
    part, used = cut(source, along < np.quantile(along, 0.35))
    result = dine.register(part, target, overlap="source-in-target")
    assert mean_error(result.moved.vertices, truth[used]) < 0.05
    # What the target shows besides is not held against it.
    assert result.report["trust"]["checks"]["remaining"] < 0.1
    assert not any("distance before is left" in reason for reason in result.trust.reasons)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_field_settles_as_noise_and_its_own_size_allow(noise):
    """A small motion, seen in a coarse mesh with noise, is not drowned by following the noise."""
    rng = np.random.default_rng(0)
    here = oriented_points(organ(), 2400, rng)
    here = here.at(evenly(here.points, 600))
    coarse = organ(40.0, subdivisions=3)
    off = noise * rng.normal(size=coarse.vertices.shape)
    seen = Surface(coarse.vertices + bend(coarse.vertices, 0.05) + off, coarse.faces)
    there = oriented_points(seen, 6000, rng)
    truth, prior = bend(here.points, 0.05), SURFACE.at(here.points)
    errors = []
    for settling in (0, 6):
        found = refine_on_surface(
            Outline(here, NO_CURVE),
            Outline(there, NO_CURVE, measured=len(seen.vertices)),
            [np.zeros_like(truth)],
            prior,
            SurfaceOptions(settling=settling),
        )
        errors.append(np.linalg.norm(found.posterior.mean - truth, axis=1).mean())
    # The prior allows motions ten times as large.
    assert 0.1 <= found.scale < 0.4
    assert errors[1] < 0.7 * errors[0]


@pytest.mark.parametrize("finely", [False, True])
def test_finer_processes_are_taken_where_things_move_more_finely(finely):
    """As a face does, of which the mouth moves and the cheek beside it does not."""
    rng = np.random.default_rng(0)
    here = oriented_points(organ(), 8000, rng)
    here = here.at(evenly(here.points, 2000))
    other = organ(40.0, subdivisions=5)
    move = twitch if finely else functools.partial(bend, size=0.05)
    seen = Surface(other.vertices + move(other.vertices), other.faces)
    outlines = (
        Outline(here, NO_CURVE),
        Outline(oriented_points(seen, 20_000, rng), NO_CURVE, measured=len(seen.vertices)),
    )
    truth, asked = move(here.points), []

    def finer():
        for process in FINER:
            asked.append(process)
            yield process.at(here.points)

    none, some = (
        refine_on_surface(
            *outlines, [np.zeros_like(truth)], SURFACE.at(here.points), settled, finer=further
        )
        for settled in [SurfaceOptions(settling=3)]
        for further in ((), finer())
    )
    before, after = (mean_error(x.posterior.mean, truth) for x in (none, some))
    assert none.finer == 0
    if finely:
        assert some.finer > 0
        assert after < 0.9 * before
    else:
        # The next one is asked, and refused; nothing else follows.
        assert (some.finer, len(asked)) == (0, 1)
        assert after == before


def twitch(points):
    """A field (N, 3) that is large in some small places and nothing between them."""
    centres = organ(subdivisions=2).vertices[::8]
    away = ((points[:, None] - centres) ** 2).sum(axis=2)
    push = np.random.default_rng(1).normal(0, 0.03, centres.shape)
    return np.exp(-away / (2 * 0.15**2)) @ push


def bend(points, size):
    """A smooth field (N, 3) at points (N, 3)."""
    x, y = points[:, 0], points[:, 1]
    return size * np.column_stack([np.sin(2 * y), np.cos(2 * x), x**2])


def sheet_at(*heights):
    """Flat sheets above each other, which end nowhere."""
    x, y = (grid.ravel() for grid in np.meshgrid(*2 * [np.linspace(-1, 1, 31)]))
    points = np.concatenate([np.column_stack([x, y, np.full(len(x), z)]) for z in heights])
    up = np.tile([0.0, 0, 1], (len(points), 1))
    return Outline(OrientedPoints(points, up, np.zeros(len(points), bool)), NO_CURVE)


@pytest.mark.parametrize("looks", ["source_looks", "target_looks"])
def test_a_scan_that_does_not_look_pulls_at_nothing(looks):
    """What only one of the scans shows, a second sheet, is to have no effect."""
    heights = ([0.0, -0.4], [0.3]) if looks == "source_looks" else ([0.0], [0.3, 0.7])
    source, target = (sheet_at(*some) for some in heights)
    prior = SURFACE.at(source.places)
    start = [np.zeros_like(source.places)]
    moved = {}
    for value in (True, False):
        # At a coarse deviation; a fine one would not see the second sheet in either case.
        options = SurfaceOptions(firsts=(0.2,), between=0.2, last=0.2, **{looks: value})
        found = refine_on_surface(source, target, start, prior, options)
        moved[value] = found.posterior.mean[-31 * 31 :, 2].mean()
    assert abs(moved[False] - 0.3) < 0.05
    assert moved[True] - moved[False] > 0.04


def test_landmarks_guide_where_surfaces_leave_it_open():
    """A spheroid turned about its axis has the same surface as before."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    source = Surface(np.asarray(ball.vertices) * [30.0, 20.0, 20.0], np.asarray(ball.faces))
    turn = trimesh.transformations.rotation_matrix(np.radians(25), [1, 0, 0])[:3, :3]
    truth = source.vertices @ turn.T
    target = Surface(truth[:, [0, 2, 1]] * [1, 1, -1], source.faces)  # other vertices
    marked = np.argsort(source.vertices[:, 0])[len(truth) // 2 :: 60]
    guide = (source.vertices[marked], truth[marked])
    settings = {"prealign": "off", "guide": guide, "guide_error": 0.3}
    guided = dine.register(source, target, **settings)
    free = dine.register(source, target, prealign="off")
    assert mean_error(guided.moved.vertices, truth) < 2.5
    assert mean_error(free.moved.vertices, truth) > 5
    assert guided.report["settings"]["guides"] == len(marked)
    # Enough of them say how the source lies, too.
    aligned = dine.register(source, target, guide=guide)
    assert mean_error(aligned.alignment.align(source.vertices), truth) < 0.1


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"overlap": "some"}, "The overlap is 'some'; expected one of auto, both"),
        ({"overlap": "both", "partial": True}, "The overlap is both, which is not partial"),
        ({"overlap": "both", "surfaces": False}, "only surfaces tell what belongs together"),
        ({"overlap": "both", "rounds": 0}, "only surfaces tell what belongs together"),
        ({"guide": (np.eye(3), np.eye(3)), "surfaces": False}, "Landmarks guide the refinement"),
        ({"guide": (np.eye(3), np.eye(3)), "guide_error": 0.0}, "error of the guiding landmarks"),
        ({"guide": (np.eye(3), np.eye(3)[:2])}, "expected as many rows"),
        ({"guide": (np.zeros((0, 3)), np.zeros((0, 3)))}, "There are no landmarks to keep to"),
        ({"guide_error": 2.0}, "needs such landmarks"),
        ({"overlap": "both", "prior": "none.prior"}, "expected auto or target-in-source"),
    ],
)
def test_settings_that_exclude_each_other_are_refused(pair, settings, said):
    with pytest.raises(DineError, match=said):
        dine.register(pair[0], pair[1], **settings)


def test_scans_that_share_their_points_are_matched_exactly():
    rng = np.random.default_rng(0)
    source = sample_surface(organ(), 500, rng).places(organ().vertices)
    truth = bent(source)
    shuffled = truth[rng.permutation(500)]
    result = dine.register(source, shuffled, prealign="off")
    assert mean_error(result.moved.vertices, truth) < 1e-3


def test_the_command_goes_on_to_the_surfaces_unless_told_not_to(pair, tmp_path):
    for name, surface in zip(("before", "after"), pair, strict=False):
        write_surface(tmp_path / f"{name}.ply", surface)
    out = tmp_path / "moved.ply"
    files = (tmp_path / "before.ply", tmp_path / "after.ply")
    error = {}
    for more in ([], ["--no-surfaces"]):
        command = ["register", *map(str, files), "-o", str(out), "--overwrite", *more]
        done = CliRunner().invoke(cli, command)
        assert done.exit_code == 0, done.exception
        used = read_json(out.with_suffix(".json"))["settings"]["surfaces"]
        error[used] = mean_error(read_surface(out).vertices, pair[2])
    assert error[True] < 0.02 < error[False]


def test_an_open_sheet_does_not_shrink_to_be_rid_of_its_rim():
    """Nearly flat, so that it might slide anywhere; its rim says where it belongs."""
    x, y = (
        grid.ravel() for grid in np.meshgrid(np.linspace(-1, 1, 41), np.linspace(-0.7, 0.7, 29))
    )
    corner = np.arange(40 * 28) % 40 + 41 * (np.arange(40 * 28) // 40)
    faces = np.concatenate([corner[:, None] + [0, 1, 42], corner[:, None] + [0, 42, 41]])
    sheet = Surface(np.column_stack([x, y, 0.1 * (x**2 - y**2)]), faces)
    truth = sheet.vertices + 0.05 * np.column_stack([np.sin(y), np.zeros_like(x), np.cos(2 * x)])
    # Other triangles of the same surface.
    middles = truth[faces].mean(axis=1)
    split = np.concatenate(
        [np.column_stack([faces[:, [i, (i + 1) % 3]], len(truth) + np.arange(len(faces))])
         for i in range(3)]
    )  # fmt: skip
    target = Surface(np.concatenate([truth, middles]), split)
    result = dine.register(sheet, target, prealign="off")
    assert mean_error(result.moved.vertices, truth) < 0.015


def test_whole_scans_are_judged_by_the_calibration(pair):
    result = dine.register(pair[0], pair[1], prealign="off")
    assert result.report["overlap_found"] == "auto"
    assert result.uncertainty is not None


def stripes(*kept):
    """A flat sheet 2 wide that is cut at some places in x; where it was cut, it has a rim."""
    low, high = kept
    x, y = (g.ravel() for g in np.meshgrid(np.linspace(low, high, 41), np.linspace(-1, 1, 41)))
    points = np.column_stack([x, y, np.zeros(len(x))])
    up = np.tile([0.0, 0, 1], (len(points), 1))
    rim = (np.abs(x - low) < 1e-9) | (np.abs(x - high) < 1e-9)
    ends = np.column_stack([np.repeat([low, high], 41), np.tile(y[::41], 2), np.zeros(82)])
    along = Curve(ends, np.tile([0.0, 1, 0], (82, 1)))
    return Outline(OrientedPoints(points, up, rim), along)


def test_rims_of_parts_do_not_pull_at_each_other():
    """Two parts of one sheet lie where they belong; one is cut a third of the way further on."""
    source, target = stripes(-1.0, 1.0), stripes(-0.4, 1.6)
    prior = SURFACE.at(source.places)
    start = [np.zeros_like(source.places)]
    moved = {}
    for parts in (True, False):
        options = SurfaceOptions(parts=parts, missing=0.2 if parts else 1.0)
        found = refine_on_surface(source, target, start, prior, options)
        moved[parts] = np.abs(found.posterior.mean).max()
    assert moved[True] < 0.02
    assert moved[False] > 0.2


def test_what_only_one_part_shows_finds_nothing_beside_the_other():
    """A second sheet above one that both show has no counterpart, nor an end of the other near."""
    source, target = sheet_at(0.0, 0.25), sheet_at(0.0)
    prior = SURFACE.at(source.places)
    start = [np.zeros_like(source.places)]
    moved = {}
    for parts in (True, False):
        options = SurfaceOptions(firsts=(0.1,), between=0.1, last=0.1, parts=parts)
        found = refine_on_surface(source, target, start, prior, options)
        moved[parts] = found.posterior.mean[-31 * 31 :, 2].mean()
    assert abs(moved[True]) < 0.02
    assert moved[False] < -0.1


@pytest.mark.parametrize("flipped", [True, False])
def test_a_mirror_image_is_told(pair, flipped):
    source, target, _ = pair
    if flipped:
        target = mirrored(target)
    result = dine.register(source, target)
    assert any("mirror image" in reason for reason in result.trust.reasons) == flipped
    if flipped:
        assert result.trust.verdict != "plausible"


@pytest.mark.parametrize("flipped", [True, False])
def test_a_mirror_image_is_told_of_what_is_nearly_symmetric(flipped):
    """Rigidly it lies as well on one side as on the other."""
    ball = trimesh.creation.icosphere(subdivisions=4)
    vertices = np.asarray(ball.vertices)
    reach = np.ones(len(vertices))
    for direction, height in (((0, 1, 0.3), 0.8), ((0, -0.5, 1), 0.5), ((0.8, 0.2, 0.5), 0.2)):
        along = vertices @ (np.array(direction) / np.linalg.norm(direction))
        reach += height * np.exp(-(1 - along) / 0.3**2)
    source = Surface(vertices * reach[:, None] * [0.6, 0.5, 0.4], np.asarray(ball.faces))
    target = Surface(bent(source.vertices), source.faces)
    result = dine.register(source, mirrored(target) if flipped else target)
    assert any("mirror image" in reason for reason in result.trust.reasons) == flipped


def test_a_mirror_image_is_told_of_parts(overlapping):
    source, target, _, _ = overlapping
    reasons = " ".join(dine.register(source, mirrored(target), overlap="both").trust.reasons)
    assert "mirror image" in reasons


def test_a_symmetric_object_is_no_mirror_image_of_itself():
    ball = trimesh.creation.icosphere(subdivisions=4)
    source = Surface(np.asarray(ball.vertices) * [1.0, 0.7, 0.5], np.asarray(ball.faces))
    target = mirrored(Surface(bent(source.vertices), source.faces))
    result = dine.register(source, target)
    assert not any("mirror image" in reason for reason in result.trust.reasons)


def test_mirroring_turns_faces_over():
    found = oriented_points(mirrored(organ()), 500, np.random.default_rng(0))
    assert ((found.normals * found.points).sum(axis=1) > 0).mean() > 0.98


@pytest.mark.parametrize("seed", range(2))
def test_parts_that_can_lie_within_each_other_overlap_instead(seed):
    """Turned round, nearly all of one part would find something of the other."""
    source, other = organ(), organ(50)
    keep = source.vertices[source.faces].mean(axis=1)[:, 1] < 0.25
    source = only_faces(source, keep)
    target = only_faces(other, other.vertices[other.faces].mean(axis=1)[:, 1] > -0.25)
    truth, shown = bent(source.vertices), source.vertices[:, 1] > -0.2
    target = Surface(bent(target.vertices), target.faces)
    result = dine.register(source, target, overlap="both", seed=seed)
    assert mean_error(result.moved.vertices[shown], truth[shown]) < 0.05


def only_faces(surface, keep):
    used, index = np.unique(surface.faces[keep], return_inverse=True)
    return Surface(surface.vertices[used], index.reshape(-1, 3))


@pytest.fixture
def looks(monkeypatch):
    """What is found where is said by a function of ``far``, how far an alignment shifts the source,
    of the detail, and of whether something was known before."""
    here = organ().vertices[::50]

    def use(said, shifts):
        def pair(far):
            shift = np.eye(4)
            shift[0, 3] = far
            alignment = Alignment.of(here, shift)
            there = alignment.frame.normalise(here)
            return Pair(organ(), organ(), alignment, here, alignment.normalise(here), there)

        def correspond(pair, model, settings, detail=FULL, before=None):
            far = pair.alignment.matrix[0, 3]
            end = said(far, detail is FULL, settings.overlap is Overlap.BOTH)
            still = np.zeros_like(pair.start)
            found = Correspondence(pair.start, pair.goal, still, None, np.ones(len(still), bool))
            return dataclasses.replace(
                found, anywhere=np.zeros_like, improbability=end[0], shown=end[1], unmet=0.2
            )

        def aligned(source, target, settings, convention):
            parts = settings.overlap is Overlap.BOTH
            return [pair(far) for far in (shifts if parts else shifts[:1])]

        monkeypatch.setattr(overlap, "aligned_pairs", aligned)
        monkeypatch.setattr(overlap, "correspond", correspond)
        settings = Settings("auto", 40, Overlap.AUTO, 1024, 0, None, True, None)
        model = Model(None, Path(), {})
        found, correspondence = overlap.correspondence_of(organ(), organ(), model, settings)
        return float(found.alignment.matrix[0, 3]), correspondence

    return use


MOST = (0.8, 0.8)


def test_auto_takes_scans_for_parts_where_that_is_more_probable(looks):
    chosen, found = looks(lambda far, *_: (1000.0 - 300 * far, MOST), [0.0, 1.0])
    assert (chosen, found.overlap, found.rival) == (1.0, Overlap.BOTH, False)


def test_auto_keeps_wholes_that_another_alignment_is_hardly_better_than(looks):
    chosen, found = looks(lambda far, *_: (1000.0 - 30 * far, MOST), [0.0, 1.0])
    assert (chosen, found.overlap, found.rival) == (0.0, Overlap.AUTO, True)


def test_auto_takes_scans_for_parts_only_if_what_both_show_is_about_as_large(looks):
    """Any whole can be bent so that it lies within some of another."""

    def said(far, full, parts):
        return (1000.0 - 300 * far, (0.9, 0.2) if far else MOST)

    chosen, found = looks(said, [0.0, 1.0])
    assert (chosen, found.overlap, found.rival) == (0.0, Overlap.AUTO, False)


def test_an_alignment_that_only_looks_better_is_not_taken(looks):
    def said(far, full, parts):
        return (1000.0 + (300 if full else -300) * far, MOST)

    chosen, found = looks(said, [0.0, 1.0])
    assert (chosen, found.overlap, found.rival) == (0.0, Overlap.AUTO, False)


def test_one_by_which_neither_lies_within_the_other_is_carried_on_whatever_looks_better(looks):
    def said(far, full, parts):
        within = (1.0, 0.5) if far > 1 else MOST
        return (1000.0 + (400 if full else -400) * (far > 1) - 100 * (far == 1), within)

    chosen, found = looks(said, [0.0, 1.0, 2.0, 3.0, 4.0])
    assert (chosen, found.overlap, found.rival) == (1.0, Overlap.BOTH, False)
