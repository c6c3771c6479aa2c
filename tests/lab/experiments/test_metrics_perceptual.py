"""LPIPS as a metric of a comparison: its value by torchmetrics, its file, and tables without it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Iterator, List, Tuple

import pytest
import torch
from torch import Tensor, nn

from legs_loss import LegsError
from legs_loss.cli import main
from legs_loss.lab.experiments.tables import MISSING, with_values
from legs_loss.lab.training.metrics import METRICS, left_out, score
from legs_loss.lab.training.perceptual import network_name, use_lpips

pytest.importorskip("numba")


class Fire(nn.Module):
    """A module of SqueezeNet; its parts have torchvision's names."""

    def __init__(self, inputs: int, squeezed: int, each: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(inputs, squeezed, 1)
        self.expand1x1 = nn.Conv2d(squeezed, each, 1)
        self.expand3x3 = nn.Conv2d(squeezed, each, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        x = self.squeeze(x).relu()
        return torch.cat([self.expand1x1(x).relu(), self.expand3x3(x).relu()], 1)


def squeeze() -> nn.Sequential:
    def pool() -> nn.Module:
        return nn.MaxPool2d(3, 2, ceil_mode=True)

    fires = (Fire(64, 16, 64), Fire(128, 16, 64), pool(), Fire(128, 32, 128), Fire(256, 32, 128), pool())
    last = (Fire(256, 48, 192), Fire(384, 48, 192), Fire(384, 64, 256), Fire(512, 64, 256))
    return nn.Sequential(nn.Conv2d(3, 64, 3, 2), nn.ReLU(), pool(), *fires, *last)


def alex() -> nn.Sequential:
    layers: List[nn.Module] = [nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2)]
    layers += [nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2)]
    for inputs, outputs in ((192, 384), (384, 256), (256, 256)):
        layers += [nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU()]
    return nn.Sequential(*layers)


def vgg() -> nn.Sequential:
    layers: List[nn.Module] = []
    inputs = 3
    for outputs, count in ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3)):
        layers += [nn.MaxPool2d(2, 2)] if layers else []
        for _ in range(count):
            layers += [nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU()]
            inputs = outputs
    return nn.Sequential(*layers)


# The features of torchvision's squeezenet1_1, alexnet and vgg16.
MAKERS = {"squeeze": squeeze, "alex": alex, "vgg": vgg}


@pytest.fixture(autouse=True)
def _no_network_stays() -> Iterator[None]:
    yield
    use_lpips(None)


def images() -> Tuple[Tensor, Tensor]:
    first, second = torch.rand(2, 3, 48, 64, generator=torch.Generator().manual_seed(0))
    return first, second


def state_dict(folder: Path, name: str = "squeeze") -> Path:
    """Write random weights under torchvision's names, with a classifier's beside them."""
    torch.manual_seed(1)
    state = {f"features.{key}": value for key, value in MAKERS[name]().state_dict().items()}
    torch.save({**state, "classifier.1.weight": torch.zeros(10, 4)}, str(folder / f"{name}.pth"))
    return folder / f"{name}.pth"


@pytest.mark.parametrize("name", MAKERS)
def test_it_is_torchmetrics_own_of_both_splits(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    library: Any = pytest.importorskip("torchmetrics.functional.image.lpips")
    use_lpips(state_dict(tmp_path, name))
    assert network_name() == name
    torch.manual_seed(1)
    features = MAKERS[name]()
    monkeypatch.setattr(library, "_get_tv_model_features", lambda net, pretrained=False: features)
    first, second = images()
    with torch.no_grad():
        expected = float(library._LPIPS(net=name, pnet_rand=True)(first[None], second[None], normalize=True))
    assert expected > 0
    for split in ("train", "test"):
        assert score(first, second, split)["lpips"] == pytest.approx(expected, rel=1e-3)
        assert score(first, first, split)["lpips"] == 0.0
    assert left_out() == ""
    use_lpips(None)
    assert "lpips" not in score(first, second)
    assert left_out().startswith("Left out: LPIPS (--lpips WEIGHTS")


class _Harm:
    def __reduce__(self) -> Tuple[Any, ...]:
        return exec, ("raise SystemExit('a file ran')",)


def test_a_wrong_file_is_one_line_and_is_never_run(tmp_path: Path) -> None:
    path = tmp_path / "weights.pth"
    with pytest.raises(LegsError, match="cannot read"):
        use_lpips(path)
    path.write_bytes(b"no weights")
    with pytest.raises(LegsError, match="more than tensors: give a state dict of torchvision's squeezenet1_1"):
        use_lpips(path)
    for wrong in ({"features.0.weight": torch.zeros(2)}, {1: 2}, [torch.zeros(2)], {"features.0.weight": "text"}):
        torch.save(wrong, str(path))
        with pytest.raises(LegsError, match="weights of another network"):
            use_lpips(path)
    torch.save({"features.0.weight": _Harm()}, str(path))
    with pytest.raises(LegsError, match="this file holds more than tensors"):
        use_lpips(path)
    use_lpips(state_dict(tmp_path))
    with pytest.raises(LegsError, match="at least 32 pixels a side"):
        score(torch.rand(3, 20, 64), torch.rand(3, 20, 64))


@pytest.mark.slow
def test_a_comparison_scores_it_in_every_process(
    tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, words = tmp_path / "out", ["--arms", "legs", "--seeds", "1", "--iterations", "3", "-r", "1"]
    assert main(["compare", str(tiny_scene), "-m", str(out), *words, "--lpips", str(state_dict(tmp_path))]) == 0
    assert "held-out LPIPS" in capsys.readouterr().out
    for row in out.glob("*/seed-0/row.json"):
        found = json.loads(row.read_text(encoding="utf-8"))
        assert found["versions"]["lpips"] == "squeeze"
        assert 0 < found["metrics"]["train"]["lpips"] < 10 and 0 < found["metrics"]["test"]["lpips"] < 10
    assert main(["compare", str(tiny_scene), "-m", str(tmp_path / "other"), *words, "--lpips", str(out)]) == 2
    said = capsys.readouterr().err
    assert "cannot read" in said and "Traceback" not in said


def test_a_column_that_no_row_has_is_left_out() -> None:
    heads = ["arm", "held-out PSNR", METRICS["lpips"].column("test")]
    assert with_values(heads, [["a", MISSING, MISSING]]) == (heads[:2], [["a", MISSING]])
    assert with_values(heads, [["a", MISSING, MISSING], ["b", "1", "0.1"]])[0] == heads
