"""Shape models of families whose modes are known in closed form."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from sklearn.decomposition import PCA

from dine.errors import ConfigError, DataError
from dine.geometry.procrustes import generalised_procrustes
from dine.geometry.surface import Surface
from dine.priors.organ import load_organ_prior
from dine.priors.shape_model import Member, rms, shape_model_of
from dine.priors.shape_quality import shape_quality

pytestmark = pytest.mark.numerical

# Six shapes around a circle of amplitudes: two modes, uncorrelated, of variance 0.6 each.
ANGLES = 2 * np.pi * (np.arange(6) + 0.3) / 6
CIRCLE = np.column_stack([np.cos(ANGLES), np.sin(ANGLES)])
LONG, SHORT = 0.2, 0.1


def template():
    """An ellipsoid whose second moments are those of its axes, with a hole."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    return Surface(ball.vertices * [30.0, 20.0, 15.0], ball.faces[1:], name="template")


def ways():
    """(2, V, 3) stretches along axes, which neither turn nor shift the ellipsoid."""
    x, y, z = template().vertices.T
    return np.stack(
        [LONG * np.column_stack([x, 0 * x, 0 * x]), SHORT * np.column_stack([0 * x, y, -z])]
    )


def family(amplitudes):
    return template().vertices + np.tensordot(amplitudes, ways(), axes=1)


def anywhere(shapes):
    """Each in a pose of its own."""
    rng = np.random.default_rng(4)
    turns = Rotation.random(len(shapes), rng).as_matrix()
    return shapes @ turns.swapaxes(1, 2) + rng.normal(scale=100, size=(len(shapes), 1, 3))


def model_of(shapes, **options):
    members = [Member(str(i), shape) for i, shape in enumerate(shapes)]
    return shape_model_of(options.pop("template", template()), members, **options)


@pytest.fixture(scope="module")
def model():
    return model_of(anywhere(family(CIRCLE)))


def test_procrustes_undoes_poses():
    given = template().vertices
    mask = np.ones(len(given), bool)
    found = generalised_procrustes(anywhere(family(CIRCLE)), given, mask)
    assert np.allclose(found, family(CIRCLE), atol=1e-6)


def test_mean_and_modes_are_those_of_the_family(model):
    assert np.allclose(model.mean, template().vertices, atol=1e-6)
    expected = np.sqrt(0.6) * ways()
    signs = np.sign((model.modes[:2] * expected).sum(axis=(1, 2)))
    assert np.allclose(model.modes[:2] * signs[:, None, None], expected, atol=1e-5)
    assert np.allclose(model.deviations[:2], rms(expected, template().used))
    assert len(model.modes) == 2


def test_the_prior_is_the_same_model(model, tmp_path):
    model.prior.save(tmp_path / "model.prior")
    prior = load_organ_prior(tmp_path / "model.prior")
    prior.check(template())
    size = prior.frame.scale
    assert np.allclose(prior.template.vertices + size * prior.mean, model.mean, atol=1e-4)
    ours, theirs = model.modes.reshape(2, -1), size * prior.modes.reshape(2, -1)
    assert np.allclose(ours.T @ ours, theirs.T @ theirs, atol=1e-3)


def test_scores_say_how_unusual_a_shape_is(model):
    scores = np.stack([model.scores(shape) for shape in anywhere(family(CIRCLE))])
    assert np.allclose(np.abs(scores), np.abs(CIRCLE) / np.sqrt(0.6), atol=1e-5)
    (new,) = anywhere(family([[2.0, 0.0]]))
    assert np.allclose(np.abs(model.scores(new)), [2 / np.sqrt(0.6), 0], atol=1e-5)
    assert model.residual(new) < 1e-4
    bent = new + np.array([0, 0, 1.0]) * np.sin(template().vertices[:, [0]] / 5)
    assert model.residual(bent) > 0.1


def test_shapes_of_amplitudes_and_draws(model):
    assert np.allclose(model.shape().vertices, model.mean)
    assert np.allclose(model.shape([0, 1.5]).vertices - model.mean, 1.5 * model.modes[1])
    drawn = model.draw(4000, seed=3)
    spread = np.sqrt(((drawn - model.mean) ** 2).mean())
    assert spread == pytest.approx(np.sqrt((model.modes**2).sum(axis=0).mean()), rel=0.05)
    with pytest.raises(DataError, match="up to 2 finite"):
        model.shape([1, 2, 3])


def test_compactness_is_the_share_of_the_variance(model):
    first, second = (ways() ** 2).sum(axis=(1, 2))
    found = shape_quality(model, draws=10).compactness
    assert np.allclose(found, [0, first / (first + second), 1])


def test_generalisation_is_that_of_other_peoples_components(model):
    quality = shape_quality(model, draws=10)
    shapes = family(CIRCLE).reshape(6, -1)
    for number in (1, 2):
        missed = []
        for row in range(6):
            pca = PCA(number).fit(np.delete(shapes, row, axis=0))
            back = pca.inverse_transform(pca.transform(shapes[[row]]))
            missed.append(rms((back - shapes[[row]]).reshape(-1, 3), template().used))
        assert quality.generalisation[number] == pytest.approx(np.mean(missed), abs=1e-4)
        error = np.std(missed, ddof=1) / np.sqrt(6)
        assert quality.generalisation_error[number] == pytest.approx(error, abs=1e-4)
    # The mean of the others lies opposite, a fifth as far.
    expected = 1.2 * rms(np.tensordot(CIRCLE, ways(), axes=1), template().used).mean()
    assert quality.generalisation[0] == pytest.approx(expected, rel=1e-5)


def test_specificity_is_that_of_shapes_drawn_otherwise(model):
    quality = shape_quality(model, draws=4000, seed=1)
    shapes = family(CIRCLE)
    rng = np.random.default_rng(99)
    for number in (0, 1, 2):
        amplitudes = np.sqrt(0.6) * rng.normal(size=(3000, 2))
        amplitudes[:, number:] = 0
        drawn = family(amplitudes)
        nearest = np.min([rms(drawn - shape, template().used) for shape in shapes], axis=0)
        assert quality.specificity[number] == pytest.approx(nearest.mean(), rel=0.06)
    assert quality.specificity_error[0] == pytest.approx(0, abs=1e-9)
    assert quality.specificity_error[2] > 0
    rows = list(quality.rows())
    assert [row["modes"] for row in rows] == [0, 1, 2]
    assert rows[2]["specificity_percent"] == pytest.approx(100 * rows[2]["specificity"] / 30)


def test_more_modes_than_others_have_cannot_generalise():
    rng = np.random.default_rng(0)
    shapes = template().vertices + rng.normal(size=(4, 162, 3))
    quality = shape_quality(model_of(shapes), draws=10)
    assert len(quality.compactness) == 4  # 0 to 3 modes, of which others have 2
    assert np.isfinite(quality.generalisation[:3]).all()
    assert np.isnan(quality.generalisation[3])
    assert (np.diff(quality.generalisation[:3]) < 0).all()


def test_modes_of_noise_are_not_kept():
    rng = np.random.default_rng(0)
    shapes = family(rng.normal(size=(12, 2))) + rng.normal(scale=0.02, size=(12, 162, 3))
    found = model_of(shapes)
    assert len(found.modes) == 11
    assert found.kept == 2
    assert len(found.prior.modes) == 2  # of which shapes left out are most probable
    assert model_of(shapes, modes=5).kept == 5


def test_size_is_no_part_of_a_scaled_model():
    sizes = np.linspace(0.8, 1.3, 6)[:, None, None]
    shapes = family(CIRCLE * [0, 1]) * sizes
    scaled = model_of(anywhere(shapes), scale=True, modes=1)
    assert scaled.deviations[0] > 50 * scaled.deviations[1:].max(initial=0)
    assert np.allclose(scaled.scores(3 * shapes[0]), scaled.scores(shapes[0]))
    with_size = model_of(anywhere(shapes), modes=2)
    assert with_size.deviations[1] > 0.1 * with_size.deviations[0]


def test_unused_vertices_take_no_part():
    stray = Surface(
        np.concatenate([template().vertices, [[500.0, 0, 0]]]), template().faces, "stray"
    )
    shapes = [
        np.concatenate([shape, [[900.0 + 50 * i, 7, 3]]]) for i, shape in enumerate(family(CIRCLE))
    ]
    found = model_of(shapes, template=stray)
    assert np.allclose(found.mean[:-1], template().vertices, atol=1e-6)
    assert len(found.modes) == 2
    assert np.array_equal(found.mean[-1], [500, 0, 0])
    assert found.radius == pytest.approx(30)


def test_members_that_are_not_used_change_nothing(model):
    members = [Member(str(i), shape) for i, shape in enumerate(anywhere(family(CIRCLE)))]
    members.insert(2, Member("doubtful", family([[9, 9]])[0], used=False))
    members.append(Member("failed", None, used=False))
    found = shape_model_of(template(), members)
    assert np.array_equal(found.mean, model.mean)
    assert len(found.members) == 8


def test_what_no_model_can_be_made_of():
    with pytest.raises(DataError, match="2 of 2 scans are usable; a shape model needs 3"):
        model_of(family(CIRCLE[:2]))
    members = [Member(str(i), shape) for i, shape in enumerate(family(CIRCLE[:2]))]
    members += [Member("a", members[0].vertices, used=False), Member("b", None, used=False)]
    with pytest.raises(DataError, match="2 of 4 scans are usable, 1 are left out as doubtful, 1 f"):
        shape_model_of(template(), members)
    with pytest.raises(DataError, match="All 4 shapes are equal but for their pose and size"):
        model_of(anywhere(family(np.ones((4, 2)))), scale=True)
    with pytest.raises(ConfigError, match="5 modes were asked for, but 6 shapes differ in 2 ways"):
        model_of(family(CIRCLE), modes=5)
    with pytest.raises(DataError, match="cloud is a cloud; the template"):
        model_of(family(CIRCLE), template=Surface(template().vertices, name="cloud"))
    with pytest.raises(DataError, match="those of the template"):
        model_of(family(CIRCLE), modes=1).scores(np.zeros((5, 3)))
