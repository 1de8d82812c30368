"""Value functions: standardisation, the bounded fit, and that skills are told apart."""

import pytest
import torch

from hippo.core.normalize import Standardizer, standardize
from hippo.core.value import ValueFunction, explained_variance


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_standardize_worked_by_hand():
    # Mean 2, population variance (1 + 0 + 1) / 3 -> std 0.8165 (the sample std would be 1).
    out = standardize(torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64))
    torch.testing.assert_close(out, torch.tensor([-(1.5**0.5), 0.0, 1.5**0.5], dtype=torch.float64), rtol=0, atol=1e-7)


def test_a_standardizer_inverts_and_leaves_constant_columns_alone():
    x = torch.stack([torch.arange(6.0), torch.full((6,), 5.0)], 1)
    scaler = Standardizer(2)
    scaler.fit(x)
    scaled = scaler(x)
    assert scaled[:, 0].std(correction=0).item() == pytest.approx(1.0, abs=1e-6)
    assert not scaled[:, 1].any()
    torch.testing.assert_close(scaler.invert(scaled), x)


def test_values_are_zero_until_fitted():
    assert not ValueFunction(3, [8], generator()).predict(torch.randn(4, 5, 3)).any()


def test_a_fit_finds_a_smooth_function_and_reports_its_error():
    value = ValueFunction(2, [32, 32], generator())
    x = torch.randn(2000, 2, generator=generator(1))
    target = (100 + 10 * torch.sin(x[:, 0]) * x[:, 1]).double()
    error = value.fit(x, target, 200)
    assert error < 0.02
    prediction = value.predict(x)
    assert prediction.dtype == torch.float64
    assert explained_variance(prediction, target) == pytest.approx(1 - error, abs=1e-3)


def test_a_fit_uses_no_more_evaluations_than_allowed_and_never_gets_worse(monkeypatch):
    value = ValueFunction(2, [8, 8], generator())
    x, calls = torch.randn(100, 2, generator=generator(1)), 0
    forward = ValueFunction.output

    def counted(self, rows, skill):
        nonlocal calls
        calls += 1
        return forward(self, rows, skill)

    monkeypatch.setattr(ValueFunction, "output", counted)
    errors = []
    for budget in (1, 3, 20):
        calls = 0
        errors.append(value.fit(x, x[:, 0].double() ** 2, budget))
        assert calls <= budget
    assert errors[0] >= errors[1] >= errors[2]  # warm start: each fit goes on where the last one stopped


def test_the_skill_conditioned_value_tells_skills_apart_in_any_row_order():
    value = ValueFunction(1, [16, 16], generator(), num_skills=3)
    skill = torch.randint(3, (600,), generator=generator(1))
    x = torch.rand(600, 1, generator=generator(2))
    target = (skill * 10 + x[:, 0] * (skill - 1)).double()
    value.fit(x, target, 150, skill)
    prediction = value.predict(x.view(20, 30, 1), skill.view(20, 30)).flatten()
    assert explained_variance(prediction, target) > 0.99
    blind = ValueFunction(1, [16, 16], generator())
    blind.fit(x, target, 150)
    assert explained_variance(blind.predict(x), target) < 0.2


def test_a_skill_conditioned_value_without_skills_is_refused():
    value = ValueFunction(1, [4], generator(), num_skills=2)
    with pytest.raises(ValueError, match="skill"):
        value.fit(torch.randn(4, 1), torch.randn(4), 5)


def test_explained_variance_worked_by_hand():
    target = torch.tensor([0.0, 2.0])
    assert explained_variance(torch.tensor([0.0, 2.0]), target) == 1.0
    assert explained_variance(torch.tensor([5.0, 5.0]), target) == 0.0
    assert explained_variance(torch.tensor([2.0, 0.0]), target) == -3.0  # residual variance 4 over variance 1
    assert explained_variance(torch.tensor([1.0, 2.0]), torch.tensor([3.0, 3.0])) == 0.0
