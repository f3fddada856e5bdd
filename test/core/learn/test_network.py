"""The network against central differences, its fitness, its training on known functions."""

import numpy as np
import pytest
import torch

from bench.ssa_problem import SsaProblem
from longarm_comp.core.learn.ensemble import _Learner
from longarm_comp.core.learn.network import NetworkShape, TanhMembers
from longarm_comp.core.learn.sparrow import SparrowSearch
from longarm_comp.core.learn.stack import Stack, TanhNetwork, TanhStack, hidden_alike
from longarm_comp.core.learn.training import back_propagate

SHAPE = NetworkShape(4, 5, 3)
CPU = torch.device("cpu")


def stack(shape=SHAPE):
    return TanhStack(shape, CPU)


def samples(x, y, many=1):
    """Of rows (N, d) and (N, k), for many networks."""
    x, y = (torch.tensor(a).repeat(many, 1, 1) for a in (x, y))
    return x, y, torch.ones_like(x[..., 0])


def xavier(shape, seed, many=1):
    return stack(shape).xavier_starts(many, torch.Generator().manual_seed(seed))


def outputs(shape, weights, x):
    return TanhMembers(shape, np.asarray(weights)).outputs(x)


@pytest.fixture
def problem():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(40, 4))
    y = rng.normal(size=(40, 3))
    return x, y, rng.normal(size=(2, SHAPE.size))


def test_the_module_the_stack_and_what_is_served_are_one_network(problem):
    x, _, weights = problem
    served = TanhMembers(SHAPE, weights).outputs(x)
    many = stack().outputs(torch.tensor(weights), torch.tensor(x).expand(2, -1, -1))
    module = TanhNetwork(SHAPE).double()
    torch.nn.utils.vector_to_parameters(torch.tensor(weights[1]), module.parameters())
    np.testing.assert_allclose(many, served, atol=1e-14)
    np.testing.assert_allclose(module(torch.tensor(x)).detach(), served[1], atol=1e-14)


def test_jacobian_is_the_central_difference(problem):
    x, _, weights = problem
    step = 1e-6
    numeric = np.stack(
        [
            (outputs(SHAPE, weights[:1] + e, x)[0] - outputs(SHAPE, weights[:1] - e, x)[0])
            / (2 * step)
            for e in step * np.eye(SHAPE.size)
        ],
        axis=2,
    )
    np.testing.assert_allclose(TanhMembers(SHAPE, weights).jacobian(x), numeric, atol=1e-8)


def test_slope_is_the_central_difference_and_its_step_keeps_the_error(problem):
    x, _, weights = problem
    members, moved = TanhMembers(SHAPE, weights), np.array([True, False, True, True])

    def mean(at):
        return members.outputs(at[None])[:, 0].mean(axis=0)

    for at in x[:5]:
        slope, step = members.slope(at, moved, 1e-4)
        h = 1e-6 * np.eye(4)[moved]
        numeric = np.stack([(mean(at + e) - mean(at - e)) / 2e-6 for e in h], axis=1)
        np.testing.assert_allclose(slope, numeric, atol=1e-8)
        for corner in step * np.random.default_rng(1).choice([-1.0, 1.0], (20, 3)):
            moved_by = np.zeros(4)
            moved_by[moved] = corner
            assert np.abs(mean(at + moved_by) - mean(at) - slope @ corner).max() < 1e-4


@pytest.mark.parametrize("shape", [SHAPE, NetworkShape(4, 25, 3)])
@pytest.mark.parametrize("kind", ["the paper's own", "any module's"])
def test_normal_equations_are_those_of_the_explicit_jacobian(problem, kind, shape):
    x, y, _ = problem
    weights = np.random.default_rng(1).normal(size=(2, shape.size))
    columns, targets, _ = samples(x, y, 2)
    row = torch.rand(2, 40, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    of = stack(shape) if kind == "the paper's own" else Stack(TanhNetwork(shape))
    residual = targets - of.outputs(torch.tensor(weights), columns)
    matrix, gradient = of.normal_equations(torch.tensor(weights), columns, residual, row)
    for k in range(2):
        jacobian = TanhMembers(shape, weights[k : k + 1]).jacobian(x)
        weighted = jacobian * row[k].numpy()[:, None, None]
        left = y - outputs(shape, weights[k : k + 1], x)[0]
        np.testing.assert_allclose(
            matrix[k].tril(), np.tril(np.einsum("nki,nkj->ij", weighted, jacobian)), atol=1e-10
        )
        np.testing.assert_allclose(gradient[k], np.einsum("nki,nk->i", weighted, left), atol=1e-10)
        np.testing.assert_allclose(residual[k], left, atol=1e-13)


def test_normal_equations_in_blocks_of_rows_are_the_same(problem, monkeypatch):
    x, y, weights = problem
    columns, targets, used = samples(x, y, 2)
    weights = torch.tensor(weights)
    left = targets - stack().outputs(weights, columns)
    whole = stack().normal_equations(weights, columns, left, used)
    monkeypatch.setattr(
        "longarm_comp.core.learn.stack._numbers_at_once", lambda device: 1300
    )  # 7 rows or less
    for of in (stack(), Stack(TanhNetwork(SHAPE))):
        matrix, gradient = of.normal_equations(weights, columns, left, used)
        np.testing.assert_allclose(matrix.tril(), whole[0].tril(), atol=1e-10)
        np.testing.assert_allclose(gradient, whole[1], atol=1e-10)


def test_population_fitness_is_the_mean_squared_error_of_each(problem):
    x, y, _ = problem
    rng = np.random.default_rng(2)
    population = rng.normal(size=(2, 70, SHAPE.size)) * 3
    columns, targets, used = samples(x, y, 2)
    used[1, 30:] = 0.0  # rows that the second network lacks
    found = stack().squared_error(columns, targets, used)(torch.tensor(population))
    for network, rows in ((0, 40), (1, 30)):
        each = outputs(SHAPE, population[network], x[:rows]) - y[:rows]
        np.testing.assert_allclose(found[network], np.mean(each**2, axis=(1, 2)), rtol=1e-5)


def test_population_fitness_survives_saturated_units(problem):
    x, y, weights = problem
    huge = torch.tensor(np.stack((weights[0] * 1e4, -weights[0] * 1e4))[None])
    assert stack().squared_error(*samples(x, y))(huge).isfinite().all()


def test_groups_cover_every_weight_once_per_input():
    group = stack().groups.numpy()
    assert len(group) == SHAPE.size
    v, w = SHAPE.split(group)
    for i in range(5):
        assert set(v[i]) == {i}
    assert set(w[:-1].ravel()) == {5} and set(w[-1]) == {6}
    own = Stack(TanhNetwork(SHAPE)).groups.numpy()
    assert [set(part.ravel()) for part in SHAPE.split(own)] == [{0}, {1}]


def bent(rng, x, noise):
    truth = np.stack((np.sin(x[:, 0]), x[:, 0] * x[:, 1], np.cos(x[:, 1])), axis=1)
    return truth, truth + noise * rng.normal(size=truth.shape)


def test_training_finds_the_noise_and_the_input_that_does_not_matter():
    rng = np.random.default_rng(3)
    x = rng.normal(size=(400, 3))
    truth, y = bent(rng, x, 0.1)
    shape = NetworkShape(3, 10, 3)
    fit = back_propagate(stack(shape), xavier(shape, 3), *samples(x, y))
    error = outputs(shape, fit.weights, x)[0] - truth
    assert np.sqrt(np.mean(error**2)) < 0.05
    assert 0.085 < fit.beta[0] ** -0.5 < 0.115
    assert fit.alpha[0, 2] > 20 * fit.alpha[0, :2].max()
    assert 10 < fit.effective[0] < shape.size
    np.testing.assert_allclose(fit.robust[0], 1.0, atol=0.2)


def test_evidence_of_a_linear_network_is_its_exact_marginal_likelihood():
    rng = np.random.default_rng(8)
    x = rng.normal(size=(50, 2))
    y = x @ [[1.0], [-0.5]] + 0.3 + 0.2 * rng.normal(size=(50, 1))
    line = Stack(torch.nn.Linear(2, 1).double())
    start = torch.zeros(1, 3, dtype=torch.float64)
    fit = back_propagate(line, start, *samples(x, y))
    of_weight, of_bias = 1.0 / fit.alpha[0].numpy()
    spread = of_weight * x @ x.T + of_bias + float(1.0 / fit.beta[0]) * np.eye(50)
    _, log = np.linalg.slogdet(2 * np.pi * spread)
    exact = -0.5 * (log + (y.T @ np.linalg.solve(spread, y)).item())
    assert float(fit.evidence[0]) == pytest.approx(exact, abs=0.1)


def test_gross_outliers_are_weighted_down_and_do_not_spoil_the_fit():
    rng = np.random.default_rng(4)
    x = rng.uniform(-1.5, 1.5, size=(400, 2))
    truth, y = bent(rng, x, 0.05)
    shape = NetworkShape(2, 8, 3)
    wrong, bad = y.copy(), rng.permutation(400)[:12]  # 3 %
    wrong[bad] += rng.choice([-3.0, 3.0], (12, 3))
    clean, spoiled = (
        back_propagate(stack(shape), xavier(shape, 4), *samples(x, one)) for one in (y, wrong)
    )
    robust = spoiled.robust[0].numpy()
    assert robust[bad].max() < 0.1 < np.delete(robust, bad).min()
    left = [
        np.sqrt(np.mean((outputs(shape, f.weights, x)[0] - truth) ** 2)) for f in (clean, spoiled)
    ]
    assert left[1] < 1.5 * left[0]
    assert spoiled.beta**-0.5 < 1.2 * clean.beta**-0.5


def test_a_batch_trains_each_network_as_if_it_were_alone():
    """Also where one learns fewer rows, and ends at another step."""
    rng = np.random.default_rng(5)
    x = rng.normal(size=(60, 3))
    _, y = bent(rng, x, 0.1)
    shape, batch = NetworkShape(3, 4, 3), samples(x, y, 3)
    start = xavier(shape, 1, 3)
    batch[2][1, 50:] = 0.0
    fits = back_propagate(stack(shape), start, *batch)
    for k, n in enumerate((60, 50, 60)):
        alone = back_propagate(stack(shape), start[k : k + 1], *samples(x[:n], y[:n]))
        np.testing.assert_allclose(fits.weights[k], alone.weights[0], rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(fits.evidence[k], alone.evidence[0], rtol=1e-6)
        np.testing.assert_allclose(fits.root[k], alone.root[0], rtol=1e-3, atol=1e-4)


def test_a_network_of_a_batch_learns_its_own_rows_alone():
    """As the folds do, also where they have not equally many."""
    rng = np.random.default_rng(6)
    x = rng.normal(size=(60, 3))
    _, y = bent(rng, x, 0.1)
    rows = rng.random((1, 60)) < 0.7

    def fits(x, y, rows):
        return _Learner(x, y, "xavier", 0, (4, 1), None, "cpu").train_batch(3, rows)

    (own,) = fits(x, y, rows)
    (alone,) = fits(x[rows[0]], y[rows[0]], np.ones((1, rows.sum()), bool))
    np.testing.assert_array_equal(own.weights, alone.weights)
    fewer = np.concatenate((rows, np.ones((1, 60), bool)))
    elsewhere = np.where(rows.T, x, 9.0)  # what the first network does not learn
    first, second = (fits(each, y, fewer) for each in (x, elsewhere))
    np.testing.assert_array_equal(first[0].weights, second[0].weights)
    assert not np.array_equal(first[1].weights, second[1].weights)


def test_sixty_sparrow_starts_have_no_collapsed_units():
    problem, shape = SsaProblem.of(300), NetworkShape(7, 12, 3)
    many, chance = 60, torch.Generator().manual_seed(0)
    fitness = problem.stack.squared_error(
        *(each.expand(60, *each.shape[1:]) for each in problem.rows)
    )
    starts = problem.stack.sparrow_starts(fitness, many, chance, SparrowSearch(20, 20))
    assert not hidden_alike(shape.split(starts)[0]).any()
    assert len(starts.unique(dim=0)) == many


def test_a_collapsed_start_is_found_and_separated_without_touching_the_rest():
    collapsed = xavier(SHAPE, 6)
    v = SHAPE.split(collapsed)[0]
    v[0, :, 3], v[0, :, 4] = v[0, :, 1], -v[0, :, 1]
    np.testing.assert_array_equal(hidden_alike(v)[0], [False, False, False, True, True])
    assert hidden_alike(torch.ones(1, 5, 5)).sum() == 4

    class Found(SparrowSearch):
        """A search that finds the collapsed start."""

        def minimise(self, fitness, lower, upper, rng):
            return collapsed, None

    chance = torch.Generator().manual_seed(7)
    apart = SHAPE.split(stack().sparrow_starts(None, 1, chance, Found()))[0]
    assert not hidden_alike(apart).any()
    np.testing.assert_array_equal(apart[0, :, :3], v[0, :, :3])
