"""The packages under docs/examples do what the README says of them."""

import importlib.util
import sys
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from pathlib import Path
from types import ModuleType

import pytest
from simple_models import install

import lagbench
from lagbench.baselines.predict import predict
from lagbench.baselines.train import train
from lagbench.data import registry
from lagbench.data import registry as plugins
from lagbench.make.generate import GenerationResult, generate
from lagbench.metrics import METRICS

EXAMPLES = Path(__file__).parent.parent / "docs" / "examples"


@pytest.fixture
def dam_break(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Make the example's split known as its entry point would."""
    folder = str(EXAMPLES / "dam_break")
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv("PYTHONPATH", folder)
    monkeypatch.delenv(registry.REGISTRY_VARIABLE, raising=False)
    point = EntryPoint(name="dam-break", value="dam_break", group=plugins.GROUP)
    monkeypatch.setattr(plugins, "entry_points", lambda group: [point])
    registry._load.cache_clear()
    yield
    registry._load.cache_clear()


def test_dam_break_is_a_split(dam_break: None, tmp_path: Path) -> None:
    """It is listed, generated and scored like one of ours; the column starts at rest and falls."""
    assert "dam-break" in registry.load().splits
    result = generate("dam-break", "tiny", subset="test", root=tmp_path)
    assert result.simulated == (3, 4)
    test = lagbench.open_split("dam-break", subset="test", size="tiny", root=tmp_path)
    height = test.position.sel(space="y").mean("particle")
    assert (height.isel(frame=-1) < 0.8 * height.isel(frame=0)).all()


def imported(name: str) -> ModuleType:
    """Return the module of an example."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / name / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def test_sage_is_a_baseline(
    monkeypatch: pytest.MonkeyPatch,
    generated: GenerationResult,
    unmeasured: registry.Registry,
    tmp_path: Path,
) -> None:
    """Its one class is a graph network that trains with the recipes of the six and predicts."""
    install(monkeypatch, sage=imported("sage").Sage)
    options = {"root": generated.root, "registry": unmeasured, "threads": 1}
    trained = train(
        "sage", "curl-noise", "tiny", output=tmp_path / "run", settings=["training.steps=2"], **options
    )
    predicted = predict(trained.weights, tmp_path / "predictions.nc", **options)
    assert predicted.method == "GNS + SAGEConv"
    assert (tmp_path / "predictions.nc").is_file()


def test_enstrophy_is_a_metric() -> None:
    """The module's METRICS is a metric that ours do not have."""
    module = imported("enstrophy")
    assert module.METRICS.name == "enstrophy_error"
    assert module.METRICS.name not in METRICS
