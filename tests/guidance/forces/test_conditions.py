"""The nine conditions are what their yaml says: the equations, composed."""

import re
import shutil

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from airhockey_marl.experiment.command import CONF
from guidance.forces import condition_specs
from guidance.forces.beyond import ApproachGatedGuidance, BlendedGuidance, ProductGuidance
from guidance.forces.condition_specs import (
    CONDITIONS,
    GUIDANCES,
    ConditionSpec,
    other_specs,
    paper_specs,
    read_spec,
    register_condition,
    select_specs,
)
from guidance.forces.conditions import (
    CombinedGuidance,
    GuidanceOutput,
    GuidanceSettings,
    NoGuidance,
    Prediction,
    Spring,
    SpringGuidance,
    Thresholds,
    build_condition,
)
from guidance.forces.equations import similarity_weight, uncertainty_weight
from guidance.study.setup import load_conditions

SPRING, UT = Spring(stiffness=50.0, limit=3.0, reach=0.075), Thresholds(0.1, 0.3)
STATE = torch.zeros(3, 12)
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


def test_all_nine_are_there_with_the_papers_letters_and_labels():
    labels = "NHG|OAHG (vanilla)|OAHG (UT)|UPHG (vanilla)|UPHG (UA)|UPHG (UT+UA)"
    labels += "|CombHG (UA)|CombHG (UA+SC)|CombHG (UT+UA+SC)"
    found = conditions()
    assert [(c.letter, c.label) for c in found] == list(zip("abcdefghi", labels.split("|"), strict=True))
    types = ["NHG", "OAHG", "OAHG", "UPHG", "UPHG", "UPHG", "CombHG", "CombHG", "CombHG"]
    assert [c.spec.type for c in found] == types


def test_a_condition_has_the_name_of_its_file():
    for path in (CONF / "condition").glob("**/*.yaml"):
        assert read_spec(path).name == path.stem


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
    assert torch.allclose(oahg(STATE, ACTION, TARGETS).force, expected)

    weight = uncertainty_weight(TARGETS["optimal"].std, 0.1, 0.3)  # (0.3 - 0.18) / 0.2
    guided = SpringGuidance("optimal", SPRING, UT)(STATE, ACTION, TARGETS)
    assert torch.allclose(guided.w_unc_optimal, torch.full((3,), 0.6)) and guided.w_unc_user is None
    assert torch.allclose(guided.force, weight[:, None] * expected)

    mean = (oahg(STATE, ACTION, TARGETS).force + uphg(STATE, ACTION, TARGETS).force) / 2
    assert torch.allclose(CombinedGuidance(oahg, uphg, similarity=False)(STATE, ACTION, TARGETS).force, mean)
    guided = CombinedGuidance(oahg, uphg, similarity=True)(STATE, ACTION, TARGETS)
    agreement = similarity_weight(oahg(STATE, ACTION, TARGETS).force, uphg(STATE, ACTION, TARGETS).force)
    assert torch.allclose(guided.force, agreement[:, None] * mean) and torch.equal(guided.w_sim, agreement)


def test_no_stiffness_is_no_guidance():
    slack = Spring(0.0, 3.0, 0.075)
    for guidance in (
        SpringGuidance("optimal", slack),
        CombinedGuidance(SpringGuidance("optimal", slack), SpringGuidance("user", slack), True),
    ):
        assert torch.equal(guidance(STATE, ACTION, TARGETS).force, NoGuidance()(STATE, ACTION, TARGETS).force)


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


def guidance_config() -> DictConfig:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = compose("evaluate").guidance
    OmegaConf.set_struct(cfg, False)
    return cfg


def settings() -> GuidanceSettings:
    return GuidanceSettings.from_config(guidance_config())


def test_a_yaml_is_all_it_takes_to_add_a_condition():
    spec = ConditionSpec("combhg_without_ua", "m", "CombHG", optimal=True, user="general")
    assert build_condition(spec, settings()).guidance.models() == {"optimal", "user"}


def test_a_decorator_is_all_it_takes_to_add_a_guidance_that_sees_the_state():
    @register_condition("push_to_puck", letter="z", label="Toward the puck", color="#123456", against=["b"])
    class PushToPuck:
        def __init__(self, settings):
            self.spring = settings.spring

        def models(self):
            return frozenset()

        def __call__(self, state, hand, predictions):
            return GuidanceOutput(self.spring.force(hand, state[..., 8:10]))

    try:
        (*_, spec) = select_specs(None, ["push_to_puck"], pytest.fail)
        assert (spec.letter, spec.color, spec.against, spec.type) == ("z", "#123456", ("b",), "beyond")
        condition = build_condition(spec, settings())
        state = STATE.clone()
        state[:, 8] = 0.01
        force = condition.guidance(state, torch.zeros(3, 2), {}).force
        assert torch.allclose(force, torch.tensor([settings().spring.stiffness * 0.075 * 0.01, 0.0]).expand(3, 2))
    finally:
        del CONDITIONS._entries["push_to_puck"], GUIDANCES._entries["push_to_puck"]


def test_a_gate_lets_the_force_through_only_while_the_puck_approaches():
    gated = ApproachGatedGuidance(GuidanceSettings(SPRING, {}), slowest=0.2)
    state = STATE.clone()
    state[:, 10] = torch.tensor([-1.0, -0.1, 1.0])
    force, whole = (g(state, ACTION, TARGETS).force for g in (gated, SpringGuidance("optimal", SPRING)))
    assert torch.equal(force[0], whole[0]) and not force[1:].any() and whole[1].any()


@pytest.fixture
def conf(tmp_path, monkeypatch):
    """A copy of conf/condition to break."""
    shutil.copytree(CONF / "condition", tmp_path / "condition")
    monkeypatch.setattr(condition_specs, "CONF", tmp_path)
    paper_specs.cache_clear()
    yield tmp_path / "condition"
    paper_specs.cache_clear()


@pytest.mark.parametrize("text", ["letter: [", "name: mine\nletter: 3\nlabel: x\n", "", "name: mine\ncolour: red\n"])
def test_a_broken_yaml_is_named_and_hurts_nobody_else(conf, text):
    (conf / "mine.yaml").write_text(text)
    assert len(paper_specs()) == 9
    warnings = []
    assert {"product", "blended"} <= set(other_specs(warnings.append))
    assert len(warnings) == 1 and str(conf / "mine.yaml") in warnings[0]
    assert len(select_specs(None, ["product"], warnings.append)) == 10


def test_one_of_the_nine_that_is_broken_is_named(conf):
    (conf / "oahg.yaml").write_text("letter: b\n")
    with pytest.raises(ValueError, match=r"oahg\.yaml: condition\.name is missing"):
        paper_specs()


def test_two_conditions_of_one_letter_are_refused(conf):
    text = (conf / "beyond" / "product.yaml").read_text()
    (conf / "beyond" / "mine.yaml").write_text(text.replace("name: product", "name: mine"))
    with pytest.raises(ValueError, match=r"condition\.letter = j is that of mine and of product"):
        select_specs(None, True, pytest.fail)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"letter": "B"}, "condition.letter = 'B' must be one of a to z"),
        ({"user": "mine"}, "condition.user = 'mine' must be null, general or adapted"),
        ({"sc": True}, "condition.sc = true needs optimal: true and a user model"),
        ({"ut": "yes"}, "condition.ut = 'yes' must be true or false"),
        ({"guidance": "product", "letter": "b"}, "condition.letter = b is of the paper"),
        ({"guidance": "product", "optimal": True}, "condition.guidance = product stands in place of"),
        ({"against": "b"}, "condition.against = 'b' must be a list of letters"),
        ({"name": "my condition"}, "condition.name = 'my condition' must be a word"),
        ({"label": ""}, "condition.label = '' must be a text"),
    ],
)
def test_a_wrong_key_of_a_condition_is_named(keys, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        ConditionSpec(**{"name": "mine", "letter": "m", "label": "Mine"} | keys)


def test_unknown_names_are_refused_with_a_hint():
    with pytest.raises(ValueError, match=r"beyond: 'prodct' must be one of .*; did you mean product\?"):
        select_specs(None, ["prodct"], pytest.fail)
    spec = ConditionSpec("mine", "m", "Mine", guidance="blendet")
    with pytest.raises(ValueError, match=r"condition\.guidance\.name = 'blendet' must be one of product, blended"):
        build_condition(spec, settings())
    spec = ConditionSpec("mine", "m", "Mine", guidance="approach_gated", settings={"slow": 1})
    with pytest.raises(ValueError, match=r"condition\.guidance\.slow: no such setting, must be one of slowest"):
        build_condition(spec, settings())


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
    product = ProductGuidance(GuidanceSettings(weak, {}))
    force = product(STATE[:1], torch.zeros(1, 2).double(), {"optimal": optimal, "adapted": user}).force
    assert torch.allclose(force[0], torch.stack(expected), atol=1e-9)


def test_blending_gives_the_force_of_the_one_that_knows():
    spring, thresholds = Spring(1.0, 100.0, 1.0), Thresholds(0.1, 0.3)
    blended = BlendedGuidance(GuidanceSettings(spring, {"optimal": thresholds, "user": thresholds}))

    def force(optimal_std, user_std):
        std = [torch.full((1, 2), s / 2**0.5).double() for s in (optimal_std, user_std)]
        targets = {
            "optimal": Prediction(torch.tensor([[1.0, 0.0]]).double(), std[0]),
            "adapted": Prediction(torch.tensor([[0.0, 1.0]]).double(), std[1]),
        }
        return blended(STATE[:1], torch.zeros(1, 2).double(), targets).force[0].tolist()

    sure, lost = 0.1, 0.9  # norms of the STD: squared, below and above the thresholds
    assert force(sure, lost) == [1.0, 0.0] and force(lost, sure) == [0.0, 1.0]
    assert force(sure, sure) == [0.5, 0.5] and force(lost, lost) == [0.0, 0.0]
    half = 0.2**0.5  # W_unc = 1/2: as much of a say as it has confidence, and together as strong as the surer one
    assert force(sure, half) == pytest.approx([2 / 3, 1 / 3])


def test_settings_without_thresholds_are_refused():
    config = guidance_config()
    del config.thresholds["user"]
    with pytest.raises(ValueError, match=r"guidance\.thresholds\.user is missing"):
        GuidanceSettings.from_config(config)
