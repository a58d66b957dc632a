"""The nine conditions are what their yaml says: the equations, composed."""

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from airhockey_marl.experiment.building import build
from airhockey_marl.experiment.command import CONF
from guidance.forces.conditions import (
    BlendedGuidance,
    CombinedGuidance,
    NoGuidance,
    Prediction,
    ProductGuidance,
    Spring,
    SpringGuidance,
    Thresholds,
)
from guidance.forces.equations import similarity_weight, uncertainty_weight
from guidance.statistics.tests import CONDITIONS
from guidance.study.provenance import load_conditions

SPRING, UT = Spring(stiffness=50.0, limit=3.0, reach=0.075), Thresholds(0.1, 0.3)
ACTION = torch.tensor([[0.2, -0.1], [-0.5, 0.5], [0.0, 0.0]])
TARGETS = {
    "optimal": Prediction(torch.tensor([[0.5, 0.3], [-0.6, 0.9], [1.0, 1.0]]), torch.full((3, 2), 0.3)),
    "user": Prediction(torch.tensor([[0.1, 0.1], [0.2, 0.2], [-1.0, 0.0]]), torch.full((3, 2), 0.2)),
    "adapted": Prediction(torch.tensor([[0.4, -0.4], [0.2, 0.8], [0.0, -1.0]]), torch.full((3, 2), 0.35)),
}


def conditions(**overrides):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = compose("evaluate", overrides=[f"{k}={v}" for k, v in overrides.items()])
    return load_conditions(cfg)


def test_all_nine_are_there_with_the_papers_letters_and_names():
    found = [(condition.letter, condition.name, condition.label) for condition in conditions()]
    assert [name for _, name, _ in found] == [path.stem for path in map(_yaml_of, found)]
    assert [(letter, label) for letter, _, label in found] == [(c.letter, c.label) for c in CONDITIONS.values()]
    assert len(found) == 9


def _yaml_of(found):
    path = CONF / "condition" / f"{found[1]}.yaml"
    assert path.is_file()
    return path


def test_one_condition_is_the_same_as_among_all():
    everything = {condition.name: condition for condition in conditions()}
    for name, condition in everything.items():
        assert conditions(condition=name) == [condition]


def test_settings_reach_every_spring_and_threshold():
    changed = conditions(**{"guidance.spring.stiffness": 12.5, "guidance.thresholds.user.high": 0.9})
    by_letter = {condition.letter: condition.guidance for condition in changed}
    assert by_letter["b"].spring.stiffness == by_letter["i"].user.spring.stiffness == 12.5
    assert by_letter["f"].uncertainty.high == by_letter["i"].user.uncertainty.high == 0.9
    assert by_letter["c"].uncertainty.high != 0.9


def test_table_1_says_which_method_is_in_which_condition():
    """Section 4.2 (a)-(i): the model, UT, UA and SC of each."""
    of = {condition.letter: condition.guidance for condition in conditions()}
    assert isinstance(of["a"], NoGuidance) and of["a"].models() == set()
    for letter, model, ut in (("b", "optimal", 0), ("c", "optimal", 1), ("d", "user", 0), ("e", "adapted", 0)):
        assert isinstance(of[letter], SpringGuidance)
        assert (of[letter].model, of[letter].uncertainty is not None) == (model, bool(ut))
    assert of["f"].model == "adapted" and of["f"].uncertainty is not None
    for letter, parts, sc in (("g", "be", False), ("h", "be", True), ("i", "cf", True)):
        assert isinstance(of[letter], CombinedGuidance)
        assert (of[letter].optimal, of[letter].user, of[letter].similarity) == (of[parts[0]], of[parts[1]], sc)


def test_forces_by_hand():
    oahg, uphg = SpringGuidance("optimal", SPRING), SpringGuidance("adapted", SPRING)
    expected = 50.0 * 0.075 * (TARGETS["optimal"].mean - ACTION)  # N; the third is beyond the clip
    expected[2] *= 3.0 / expected[2].norm()
    assert torch.allclose(oahg(ACTION, TARGETS).force, expected)

    weight = uncertainty_weight(TARGETS["optimal"].std, 0.1, 0.3)  # (0.3 - 0.18) / 0.2
    guided = SpringGuidance("optimal", SPRING, UT)(ACTION, TARGETS)
    assert torch.allclose(guided.w_unc_optimal, torch.full((3,), 0.6)) and guided.w_unc_user is None
    assert torch.allclose(guided.force, weight[:, None] * expected)

    mean = (oahg(ACTION, TARGETS).force + uphg(ACTION, TARGETS).force) / 2
    assert torch.allclose(CombinedGuidance(oahg, uphg, similarity=False)(ACTION, TARGETS).force, mean)
    guided = CombinedGuidance(oahg, uphg, similarity=True)(ACTION, TARGETS)
    agreement = similarity_weight(oahg(ACTION, TARGETS).force, uphg(ACTION, TARGETS).force)
    assert torch.allclose(guided.force, agreement[:, None] * mean) and torch.equal(guided.w_sim, agreement)


def test_no_stiffness_is_no_guidance():
    slack = Spring(0.0, 3.0, 0.075)
    for guidance in (
        SpringGuidance("optimal", slack),
        CombinedGuidance(SpringGuidance("optimal", slack), SpringGuidance("user", slack), True),
    ):
        assert torch.equal(guidance(ACTION, TARGETS).force, NoGuidance()(ACTION, TARGETS).force)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Spring(-1.0, 3.0, 0.075), "stiffness = -1.0"),
        (lambda: Spring(1.0, 3.0, 0.0), "reach = 0.0"),
        (lambda: Thresholds(0.3, 0.3), "low = 0.3"),
        (lambda: SpringGuidance("best", SPRING), "guidance.model = 'best'"),
    ],
)
def test_wrong_values_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_yaml_is_all_it_takes_to_add_a_condition():
    node = OmegaConf.load(CONF / "condition" / "combhg_ua.yaml")
    node.name, node.guidance.user.model = "combhg_without_ua", "user"
    root = OmegaConf.create({"guidance": OmegaConf.load(CONF / "guidance" / "default.yaml"), "condition": node})
    condition = build(root.condition)
    assert condition.guidance.models() == {"optimal", "user"}


def test_the_product_of_gaussians_is_that_of_scipy_and_leans_to_the_precise():
    """The mean of the product of two densities, by numerical integration."""
    grid = torch.linspace(-4, 4, 8001, dtype=torch.float64)
    optimal = Prediction(torch.tensor([[0.5, -0.2]]).double(), torch.tensor([[0.1, 0.5]]).double())
    user = Prediction(torch.tensor([[-0.5, 0.4]]).double(), torch.tensor([[0.3, 0.2]]).double())
    expected = []
    for axis in range(2):
        density = torch.ones_like(grid)
        for mean, std in (optimal, user):
            density = density * torch.exp(-0.5 * ((grid - mean[0, axis]) / std[0, axis]) ** 2)
        expected.append((grid * density).sum() / density.sum())
    weak = Spring(1.0, 100.0, 1.0)
    force = ProductGuidance("optimal", "user", weak)(
        torch.zeros(1, 2).double(), {"optimal": optimal, "user": user}
    ).force
    assert torch.allclose(force[0], torch.stack(expected), atol=1e-9)


def test_blending_gives_the_force_of_the_one_that_knows():
    spring, thresholds = Spring(1.0, 100.0, 1.0), Thresholds(0.1, 0.3)
    blended = BlendedGuidance(SpringGuidance("optimal", spring, thresholds), SpringGuidance("user", spring, thresholds))

    def force(optimal_std, user_std):
        std = [torch.full((1, 2), s / 2**0.5).double() for s in (optimal_std, user_std)]
        targets = {
            "optimal": Prediction(torch.tensor([[1.0, 0.0]]).double(), std[0]),
            "user": Prediction(torch.tensor([[0.0, 1.0]]).double(), std[1]),
        }
        return blended(torch.zeros(1, 2).double(), targets).force[0].tolist()

    sure, lost = 0.1, 0.9  # norms of the STD: squared, below and above the thresholds
    assert force(sure, lost) == [1.0, 0.0] and force(lost, sure) == [0.0, 1.0]
    assert force(sure, sure) == [0.5, 0.5] and force(lost, lost) == [0.0, 0.0]
    half = 0.2**0.5  # W_unc = 1/2: as much of a say as it has confidence, and together as strong as the surer one
    assert force(sure, half) == pytest.approx([2 / 3, 1 / 3])


def test_blending_needs_confidence():
    with pytest.raises(ValueError, match=r"guidance\.optimal\.uncertainty"):
        BlendedGuidance(
            SpringGuidance("optimal", Spring(1.0, 1.0, 1.0)),
            SpringGuidance("user", Spring(1.0, 1.0, 1.0), Thresholds(0.1, 0.2)),
        )
