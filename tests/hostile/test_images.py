"""Images from a stranger: only pictures are decoded, in this process, and only from regular files."""

from __future__ import annotations

import os

import pytest
from PIL import EpsImagePlugin, Image

from legs_loss.errors import LegsError
from legs_loss.scenes import View, image_size, load_training_image
from tests.support import legs, legs_environment, photograph, save

EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\n%%EndComments\n(%pipe%id) (r) file\nshowpage\n%%EOF\n"


@pytest.fixture
def ghostscript(tmp_path):
    """Put a ``gs`` first on a path; return that path and the file that it makes when it runs."""
    ran, program = tmp_path / "gs-ran", tmp_path / "bin" / "gs"
    program.parent.mkdir()
    program.write_text(f"#!/bin/sh\ntouch {ran}\necho 10.0\n")
    program.chmod(0o755)
    return os.pathsep.join([str(program.parent), os.environ["PATH"]]), ran


def test_an_eps_named_jpg_starts_nothing(tmp_path, ghostscript, monkeypatch):
    path, ran = ghostscript
    photo = tmp_path / "scene" / "photo.jpg"
    save(photo.with_name("real.jpg"), photograph(8, 8))
    photo.write_bytes(EPS)
    done = legs("precompute", photo.parent, env=dict(legs_environment(), PATH=path))
    assert done.returncode != 0
    assert f"{photo}: not an image in a format that is read here (JPEG, PNG," in done.stderr
    assert "Traceback" not in done.stderr
    assert not ran.exists()
    # What Pillow does by itself, or this test would prove nothing.
    monkeypatch.setenv("PATH", path)
    monkeypatch.setattr(EpsImagePlugin, "gs_binary", None)
    with pytest.raises(OSError), Image.open(str(photo)) as image:
        image.load()
    assert ran.exists()


@pytest.mark.parametrize("suffix", ["eps", "ps", "pdf", "fits", "wmf", "xpm", "psd"])
def test_what_is_no_photograph_is_not_decoded(suffix, tmp_path):
    heads = {"pdf": b"%PDF-1.4\n", "fits": b"SIMPLE  =                    T", "psd": b"8BPS\0\1", "xpm": b"/* XPM */"}
    heads["wmf"] = b"\xd7\xcd\xc6\x9a\0\0"
    path = tmp_path / "photo.png"
    path.write_bytes(heads.get(suffix, EPS).ljust(4000, b" "))
    with pytest.raises(LegsError, match="not an image in a format that is read here"):
        image_size(path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes in this file system")
def test_a_pipe_is_refused_at_once(tmp_path):
    os.mkfifo(str(tmp_path / "photo.jpg"))
    with pytest.raises(LegsError, match="not a regular file but a pipe"):
        load_training_image(View("photo.jpg", tmp_path / "photo.jpg"))


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "tif", "bmp", "ppm", "tga", "gif", "jp2"])
def test_photographs_are(suffix, tmp_path):
    assert image_size(save(tmp_path / f"photo.{suffix}", photograph(9, 7))) == (9, 7)
