"""Registries: names in configurations, settings that are refused by name, and plug-ins of other packages."""

import sys
from dataclasses import dataclass, field

import pytest
from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from airhockey_marl.experiment import registry as registries
from airhockey_marl.experiment.registry import ENVIRONMENT, Registry, construct, load_plugins


@dataclass(frozen=True)
class Circle:
    radius: float
    color: str = "red"

    def __post_init__(self):
        if not self.radius > 0:
            raise ValueError(f"shape.radius = {self.radius} must be above 0")


@dataclass(frozen=True)
class Group:
    parts: list = field(default_factory=list)
    frame: object = None


@pytest.fixture
def shapes(monkeypatch):
    monkeypatch.setattr(registries, "_registries", [])
    monkeypatch.setattr(registries, "_loaded", set(registries._loaded))
    shapes = Registry("shape", group="test_shape")
    shapes.register("circle")(Circle)
    shapes.register("group")(Group)
    return shapes


def test_a_configuration_names_what_is_built(shapes):
    node = OmegaConf.create({"size": 2.0, "shape": {"name": "circle", "radius": "${size}"}})
    assert shapes.build(node.shape, "shape") == Circle(2.0)
    assert shapes.build("group", "shape") == Group()


def test_settings_with_a_name_are_built_first_wherever_they_are(shapes):
    node = {
        "name": "group",
        "parts": [{"name": "circle", "radius": 1}, {"name": "group", "parts": [{"name": "circle", "radius": 2}]}],
        "frame": {"name": "circle", "radius": 3},
    }
    assert shapes.build(node, "shape") == Group([Circle(1), Group([Circle(2)])], Circle(3))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"name": "cirle", "radius": 1}, r"shape\.name = 'cirle' must be one of circle, group; did you mean circle\?"),
        ({"radius": 1}, r"shape\.name = None must be one of"),
        ({"name": ["circle"]}, r"shape\.name = \['circle'\] must be one of"),
        ({"name": "circle"}, r"shape\.radius is missing"),
        ({"name": "circle", "radius": 1, "colour": "red"}, r"shape\.colour: no such setting, .*; did you mean color\?"),
        ({"name": "circle", "radius": -1}, r"shape\.radius = -1 must be above 0"),
        ({"name": "group", "parts": [{"name": "square"}]}, r"shape\.parts\[0\]\.name = 'square' must be one of"),
        ({"name": "group", "frame": {"name": "circle"}}, r"shape\.frame\.radius is missing"),
        ([], r"shape = \[\] must be a mapping"),
        (None, r"shape = None must be a mapping"),
        ({1: 2}, r"shape = \{1: 2\} must be a mapping"),
        ({"_target_": "os.system", "command": "true"}, r"shape\.name = None must be one of"),
        ({"name": "os.system", "command": "true"}, r"shape\.name = 'os.system' must be one of"),
    ],
)
def test_wrong_settings_are_refused_by_name(shapes, settings, message):
    with pytest.raises(ValueError, match=message):
        shapes.build(settings, "shape")


def test_context_comes_before_the_settings(shapes):
    shapes.register("scaled")(lambda scale, radius: Circle(scale * radius))
    assert shapes.build({"name": "scaled", "radius": 2}, "shape", 3) == Circle(6)
    with pytest.raises(ValueError, match=r"shape\.scale: no such setting"):
        shapes.build({"name": "scaled", "radius": 2, "scale": 1}, "shape", 3)


def test_a_name_is_registered_once(shapes):
    shapes.register("circle")(Circle)  # as when a module is imported twice
    with pytest.raises(ValueError, match=r"shape 'circle' is registered twice: by .*\.Circle and .*\.Group"):
        shapes.register("circle")(Group)


def test_construct_checks_a_class_without_a_registry():
    assert construct(Circle, {"radius": 1}, "part") == Circle(1)
    with pytest.raises(ValueError, match=r"part\.name: no such setting"):
        construct(Circle, {"name": "circle", "radius": 1}, "part")


PLUGIN = """
import {module}
{module}.shapes.register("square")({module}.Circle)
"""


@pytest.fixture
def plugin(tmp_path, monkeypatch, shapes):
    """A folder on the path that holds a plug-in, which registers a square."""
    monkeypatch.setattr(sys.modules[__name__], "shapes", shapes)
    (tmp_path / "some_plugin.py").write_text(PLUGIN.format(module=__name__))
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    sys.modules.pop("some_plugin", None)


def test_a_plugin_is_named_in_the_environment(plugin, shapes, monkeypatch):
    assert "square" not in shapes
    monkeypatch.setenv(ENVIRONMENT, "some_plugin")
    assert list(shapes) == ["circle", "group", "square"]
    assert shapes.build({"name": "square", "radius": 2}, "shape") == Circle(2)


def test_a_plugin_is_found_through_its_entry_point(plugin, shapes):
    info = plugin / "some_plugin-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: some-plugin\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[airhockey.plugins]\nshapes = some_plugin\n")
    assert "square" in shapes


def test_what_a_plugin_registers_is_a_choice_of_the_group(plugin, shapes, monkeypatch):
    monkeypatch.setenv(ENVIRONMENT, "some_plugin")
    load_plugins()
    node = ConfigStore.instance().load("test_shape/square.yaml").node
    assert node == {"name": "square", "radius": "???", "color": "red"}


def test_a_plugin_that_cannot_be_imported_is_named(tmp_path, monkeypatch, shapes):
    (tmp_path / "bad_plugin.py").write_text("import nowhere_to_be_found\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv(ENVIRONMENT, "bad_plugin")
    message = r"plug-in bad_plugin \(AIRHOCKEY_PLUGINS\): ModuleNotFoundError: .*nowhere_to_be_found"
    with pytest.raises(ValueError, match=message):
        list(shapes)
