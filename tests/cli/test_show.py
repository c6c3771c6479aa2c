"""``legs show`` draws the views that it is given."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from legs_loss.cli.shared.sheet import Shown, save_sheet
from legs_loss.errors import LegsError
from legs_loss.spec import PRESETS, WeightSpec
from tests.support import legs, legs_environment, photograph, save

pytest.importorskip("matplotlib")
from matplotlib.axes import Axes


def colours(path):
    with Image.open(str(path)) as image:
        return np.array(image.convert("RGB"))


class TestSheet:
    def shown(self, height=60, width=80, peak=1.0):
        normalised = np.zeros((height, width), np.float16)
        normalised[height // 2 :] = peak
        photo = np.zeros((height, width, 3), np.uint8)
        photo[:, : width // 2] = (250, 0, 10)
        return Shown("images/a.png", photo, normalised)

    def test_photograph_response_and_weight_are_drawn(self, tmp_path):
        save_sheet(tmp_path / "one.png", [self.shown()], WeightSpec(), "title")
        drawn = colours(tmp_path / "one.png").reshape(-1, 3)
        # the photograph's red; magma's and viridis's two ends
        for colour in ((250, 0, 10), (0, 0, 3), (251, 252, 191), (68, 1, 84), (253, 231, 36)):
            share = (np.abs(drawn.astype(int) - colour).max(1) <= 2).mean()
            assert share > 0.01, colour

    def test_the_mean_weight_is_of_what_counts(self, tmp_path, monkeypatch):
        """A response of 0 above and of 1 below, weighted 1 and 11; the mask leaves out the upper half's left half."""
        seen = []
        monkeypatch.setattr(Axes, "set_xlabel", lambda axes, text, **how: seen.append(text))
        mask = np.ones((60, 80), np.float32)
        mask[:30, :40] = 0
        half = np.where(mask == 0, np.float32(0.5), mask)
        weights = np.full((60, 80), 3, np.float32)
        shown = [self.shown(), self.shown()._replace(mask=mask), self.shown()._replace(mask=half)]
        save_sheet(tmp_path / "a.png", [*shown, shown[1]._replace(weights=weights)], WeightSpec(), "title")
        # (1 + 1 + 11 + 11) / 4; (1 + 11 + 11) / 3; (0.5 + 1 + 11 + 11) / 3.5; three times (1 + 11 + 11) / 3
        what = "mean weight of what counts"
        assert seen[:4] == ["mean weight 6.00", f"{what} 7.67", f"{what} 6.71", f"{what} 23.00"]

    def test_a_column_a_view(self, tmp_path):
        save_sheet(tmp_path / "two.png", [self.shown()] * 2, WeightSpec(), "title")
        save_sheet(tmp_path / "four.png", [self.shown()] * 4, WeightSpec(), "title")
        assert colours(tmp_path / "four.png").shape[1] > 1.5 * colours(tmp_path / "two.png").shape[1]

    @pytest.mark.parametrize("spec", [PRESETS["3dgs"], PRESETS["eggs"], WeightSpec(percentile=50.0, normalise="mean")])
    def test_any_spec_any_view(self, tmp_path, spec):
        gray = Shown("gray", photograph(20, 90, channels=1), np.zeros((90, 20), np.float16))
        deep = Shown("deep", photograph(9, 9, channels=1).astype(np.uint16), np.zeros((9, 9), np.float16))
        missing = Shown("missing", None, self.shown().normalised)
        save_sheet(tmp_path / "a.png", [gray, deep, missing, self.shown(1, 50)], spec, "title")
        assert colours(tmp_path / "a.png").std() > 0

    def test_a_file_that_cannot_be_written(self, tmp_path):
        for name in ("absent/a.png", "a.unknown"):
            with pytest.raises(LegsError, match="cannot write"):
                save_sheet(tmp_path / name, [self.shown()], WeightSpec(), "title")


class TestShow:
    def test_scene_store_and_image(self, tmp_path, scene, store):
        for path in (scene, store, scene / "images" / "0.png"):
            done = legs("show", path, "--out", tmp_path / "sheet.png")
            assert (done.returncode, done.stdout) == (0, f"{tmp_path / 'sheet.png'}\n"), done.stderr
            assert colours(tmp_path / "sheet.png").shape[0] > 500
            (tmp_path / "sheet.png").unlink()

    def test_chosen_views_and_preset(self, tmp_path, scene):
        sheets = []
        for options in (["--views", "1"], ["--views", "images/2.png"], ["--views", "1", "--preset", "eggs"]):
            assert legs("show", scene, *options, "--out", tmp_path / "sheet.png").returncode == 0
            sheets.append(colours(tmp_path / "sheet.png"))
        assert not np.array_equal(sheets[0], sheets[1])
        assert sheets[0].shape != sheets[2].shape or not np.array_equal(sheets[0], sheets[2])

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (["{scene}", "--views", "absent"], "absent is not a view; there are 6, such as images/0.png"),
            (["{store}", "--preset", "eggs"], "has no maps for this preset"),
            (["{scene}/nothing"], "there is no file or folder"),
            (["{scene}/sparse/0/images.bin"], "not an image"),
        ],
    )
    def test_bad_input_is_one_line_and_code_2(self, tmp_path, scene, store, arguments, message):
        arguments = [argument.format(scene=scene, store=store) for argument in arguments]
        done = legs("show", *arguments, "--out", tmp_path / "sheet.png")
        assert done.returncode == 2
        assert message in done.stderr
        assert "Traceback" not in done.stderr
        assert not (tmp_path / "sheet.png").exists()

    def test_a_name_that_fits_two_views_is_not_guessed(self, tmp_path):
        save(tmp_path / "a" / "1.png", photograph(8, 8))
        save(tmp_path / "b" / "1.png", photograph(8, 8))
        done = legs("show", tmp_path, "--views", "1", "--out", tmp_path / "sheet.png")
        assert done.returncode == 2
        assert "1 fits 2 views" in done.stderr

    def test_without_matplotlib_it_says_what_to_install(self, tmp_path, scene):
        (tmp_path / "matplotlib.py").write_text("raise ImportError('hidden')")
        environment = legs_environment()
        environment["PYTHONPATH"] = f"{tmp_path}:{environment['PYTHONPATH']}"
        done = legs("show", scene, "--out", tmp_path / "sheet.png", env=environment)
        assert done.returncode == 2
        assert "pip install matplotlib, or" in done.stderr
