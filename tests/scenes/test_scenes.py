"""Scenes are read as their formats define them; damage is one clear error."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from legs_loss.errors import LegsError
from legs_loss.lab.embedded import colmap_writer
from legs_loss.lab.embedded.colmap_writer import write_colmap
from legs_loss.scenes import Camera, PointCloud, colmap, image_size, read_scene
from tests.support import colmap_scene, photograph, save

CAMERAS_TXT = """# a comment
1 PINHOLE 40 30 50 51 20 15
7 SIMPLE_PINHOLE 80 60 90 41 29
9 OPENCV 40 30 50 51 20 15 0.1 0 0 0
"""
# A half turn about x; a third of a turn about (1, 1, 1); no turn. Points follow, or an empty line.
IMAGES_TXT = """# a comment
1 0 1 0 0 1 2 3 1 b.png
10.5 20.5 -1 3 4 17
2 0.5 0.5 0.5 0.5 0 0 4 7 sub dir/a.png

3 1 0 0 0 0 0 0 9 c.png
1 1 1
"""
POINTS_TXT = """# a comment
1 0.5 1.5 -2.5 255 0 17 0.1 1 0 2 1
5 7 8 9 1 2 3 0.2
"""


def text_scene(root, images=("b.png", "sub dir/a.png", "c.png")):
    for name in images:
        save(root / "images" / name, photograph(40, 30))
    model = root / "sparse" / "0"
    model.mkdir(parents=True)
    for name, text in (("cameras", CAMERAS_TXT), ("images", IMAGES_TXT), ("points3D", POINTS_TXT)):
        (model / f"{name}.txt").write_text(text)
    return root


class TestColmapText:
    def test_views_and_cameras(self, tmp_path):
        scene = read_scene(text_scene(tmp_path))
        assert scene.kind == "colmap"
        assert [view.name for view in scene.views] == ["images/b.png", "images/c.png", "images/sub dir/a.png"]
        b, c, a = scene.views
        assert (b.camera.width, b.camera.height, b.camera.fx, b.camera.fy, b.camera.cx) == (40, 30, 50, 51, 20)
        assert np.allclose(b.camera.world_to_camera, [[1, 0, 0, 1], [0, -1, 0, 2], [0, 0, -1, 3], [0, 0, 0, 1]])
        assert (a.camera.fx, a.camera.fy, a.camera.cx, a.camera.cy) == (90, 90, 41, 29)
        # A third of a turn about the diagonal sends x to y, y to z, z to x.
        assert np.allclose(a.camera.world_to_camera[:3, :3], [[0, 0, 1], [1, 0, 0], [0, 1, 0]])
        assert c.camera is None
        assert c.camera_model == "OPENCV"
        assert all(view.path.is_file() for view in scene.views)

    def test_points(self, tmp_path):
        points = read_scene(text_scene(tmp_path)).points
        assert points.xyz.tolist() == [[0.5, 1.5, -2.5], [7, 8, 9]]
        assert points.rgb.tolist() == [[255, 0, 17], [1, 2, 3]]

    @pytest.mark.parametrize(
        ("file", "text"),
        [
            ("cameras.txt", "1 PINHOLE 40 30 50 51 20\n"),
            ("cameras.txt", "1 PINHOLE 0 30 50 51 20 15\n"),
            ("cameras.txt", "1 PINHOLE 40 thirty 50 51 20 15\n"),
            ("images.txt", "1 0 0 0 0 1 2 3 1 b.png\n\n"),
            ("images.txt", "1 nan 1 0 0 1 2 3 1 b.png\n\n"),
            ("images.txt", "1 1 0 0 0 1 2 3 1\n\n"),
            ("images.txt", "1 1 0 0 0 1 2 3 5 b.png\n\n"),
            ("points3D.txt", "1 0 0 0 256 0 0 1\n"),
            ("points3D.txt", "1 0 0\n"),
        ],
    )
    def test_damage_is_one_error_that_names_the_file(self, tmp_path, file, text):
        root = text_scene(tmp_path)
        (root / "sparse" / "0" / file).write_text(text)
        with pytest.raises(LegsError, match=file):
            read_scene(root).points  # noqa: B018 (reading it is the test)

    def test_a_lost_line_of_points_is_named(self, tmp_path):
        root = text_scene(tmp_path)
        lines = IMAGES_TXT.splitlines(True)
        for lost in (2, 4):  # of the first and of the second image; the other one still has its own
            text = "".join(line for i, line in enumerate(lines) if i != lost)
            (root / "sparse" / "0" / "images.txt").write_text(text)
            with pytest.raises(LegsError, match=rf"line {lost + 1} should have its points.*an image has two lines"):
                read_scene(root)

    def test_a_name_of_spaces_and_numbers_is_no_line_of_points(self, tmp_path):
        root = text_scene(tmp_path)
        line = "{} 1 0 0 0 0 0 0 1 my photo {}.png\n"
        (root / "sparse" / "0" / "images.txt").write_text(line.format(1, 1) + line.format(2, 2))
        with pytest.raises(LegsError, match="line 2 should have its points"):
            read_scene(root)

    @pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
    def test_a_byte_order_mark(self, tmp_path, encoding):
        root = text_scene(tmp_path)
        for file in (root / "sparse" / "0").iterdir():
            file.write_text(file.read_text(), encoding=encoding)
        scene = read_scene(root)
        assert [view.path.name for view in scene.views] == ["b.png", "c.png", "a.png"]
        assert scene.views[0].camera.fx == 50 and scene.points.xyz.shape == (2, 3)

    @pytest.mark.parametrize("ending", ["\r\n", "\r"])
    def test_line_endings_of_other_systems(self, tmp_path, ending):
        root = text_scene(tmp_path)
        for file in (root / "sparse" / "0").iterdir():
            file.write_bytes(file.read_text().replace("\n", ending).encode())
        assert [view.path.name for view in read_scene(root).views] == ["b.png", "c.png", "a.png"]

    def test_a_comment_may_be_indented_as_colmap_reads_it(self, tmp_path):
        root = text_scene(tmp_path)
        for file in (root / "sparse" / "0").iterdir():
            file.write_text(file.read_text().replace("# a comment", " \t# a comment"))
        assert len(read_scene(root).views) == 3 and read_scene(root).points.xyz.shape == (2, 3)

    def test_another_encoding_is_named_with_its_line(self, tmp_path):
        root = text_scene(tmp_path)
        (root / "sparse" / "0" / "images.txt").write_bytes(b"# \xc3\xa9\n1 0 1 0 0 1 2 3 1 caf\xe9.png\n\n")
        with pytest.raises(LegsError, match=r"line 2 is not in UTF-8: .*caf\\xe9\.png"):
            read_scene(root)


class TestModels:
    """Every camera model of COLMAP 4.2, with the parameters that pycolmap's Camera.params_info lists."""

    NAMES = {
        "SIMPLE_PINHOLE": "f, cx, cy",
        "PINHOLE": "fx, fy, cx, cy",
        "SIMPLE_RADIAL": "f, cx, cy, k",
        "RADIAL": "f, cx, cy, k1, k2",
        "OPENCV": "fx, fy, cx, cy, k1, k2, p1, p2",
        "OPENCV_FISHEYE": "fx, fy, cx, cy, k1, k2, k3, k4",
        "FULL_OPENCV": "fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6",
        "FOV": "fx, fy, cx, cy, omega",
        "SIMPLE_RADIAL_FISHEYE": "f, cx, cy, k",
        "RADIAL_FISHEYE": "f, cx, cy, k1, k2",
        "THIN_PRISM_FISHEYE": "fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, sx1, sy1",
        "RAD_TAN_THIN_PRISM_FISHEYE": "fx, fy, cx, cy, k0, k1, k2, k3, k4, k5, p0, p1, s0, s1, s2, s3",
        "SIMPLE_DIVISION": "f, cx, cy, k",
        "DIVISION": "fx, fy, cx, cy, k",
        "SIMPLE_FISHEYE": "f, cx, cy",
        "FISHEYE": "fx, fy, cx, cy",
        "EUCM": "fx, fy, cx, cy, alpha, beta",
        "EQUIRECTANGULAR": "w, h",
    }

    def test_their_parameters(self):
        assert list(colmap.MODELS.items()) == [(name, len(what.split(", "))) for name, what in self.NAMES.items()]

    def test_what_a_model_needs_is_said(self, tmp_path):
        root = text_scene(tmp_path)
        (root / "sparse" / "0" / "cameras.txt").write_text("1 FISHEYE 40 30 50 20 15\n")
        with pytest.raises(LegsError, match="a camera of model FISHEYE has 4 parameters, not 3"):
            read_scene(root)

    def test_against_pycolmap(self, tmp_path):
        pycolmap = pytest.importorskip("pycolmap", minversion="4.2")
        model = tmp_path / "sparse" / "0"
        model.mkdir(parents=True)
        (tmp_path / "images").mkdir()
        made = pycolmap.Reconstruction()
        for number, name in enumerate(colmap.MODELS, start=1):
            camera = pycolmap.Camera.create_from_model_name(number, name, 50.0, 40, 30)
            assert (camera.model.value, len(camera.params)) == (number - 1, colmap.MODELS[name])
            made.add_camera_with_trivial_rig(camera)
            image = pycolmap.Image(f"{number:02}.png", [], number, number)
            made.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
        made.write_binary(model)
        binary = read_scene(tmp_path).views
        assert [view.camera_model for view in binary] == list(colmap.MODELS)
        for file in model.iterdir():
            file.unlink()
        made.write_text(model)
        assert [view.camera_model for view in read_scene(tmp_path).views] == list(colmap.MODELS)

    def test_an_unknown_one_is_named(self, tmp_path):
        root = colmap_scene(tmp_path)
        camera = struct.pack("<IiQQ4d", 3, 18, 40, 30, 50, 51, 20, 15)
        (root / "sparse" / "0" / "cameras.bin").write_bytes(struct.pack("<Q", 1) + camera)
        with pytest.raises(LegsError, match=r"cameras\.bin .*camera 3 has model 18; known here are 0 to 17"):
            read_scene(root)


class TestColmapBinary:
    def test_a_name_in_another_encoding_is_named(self, tmp_path):
        root = colmap_scene(tmp_path)
        file = root / "sparse" / "0" / "images.bin"
        file.write_bytes(file.read_bytes().replace(b"0002.png", b"000\xe9.png"))
        with pytest.raises(LegsError, match=r"the name '000\\xe9\.png' of an image is not in UTF-8"):
            read_scene(root)

    def test_a_larger_model_beside_it_is_spoken_of(self, tmp_path):
        root = colmap_scene(tmp_path / "scene")  # of three images
        larger = colmap_scene(tmp_path / "larger", names=["1.png", "2.png", "3.png", "4.png"])
        (larger / "sparse" / "0").rename(root / "sparse" / "1")
        scene = read_scene(root)
        assert len(scene.views) == 3
        assert "1 has 4 images, and 0, which is read here as 3DGS does, has 3;" in scene.notes[0]
        (root / "sparse" / "1").rename(root / "sparse" / "2")
        (root / "sparse" / "2" / "images.bin").write_bytes(b"damaged")
        assert read_scene(root).notes == ()

    def test_against_bytes_packed_by_hand(self, tmp_path):
        model = tmp_path / "sparse" / "0"
        model.mkdir(parents=True)
        (tmp_path / "images").mkdir()
        camera = struct.pack("<IiQQ4d", 3, 1, 40, 30, 50, 51, 20, 15)
        (model / "cameras.bin").write_bytes(struct.pack("<Q", 1) + camera)
        image = struct.pack("<I7dI", 8, 0, 1, 0, 0, 1, 2, 3, 3) + "é.png".encode() + b"\0"
        image += struct.pack("<Q", 2) + struct.pack("<ddq", 1.5, 2.5, -1) * 2
        (model / "images.bin").write_bytes(struct.pack("<Q", 1) + image)
        point = struct.pack("<Q3d3Bd", 4, 1, 2, 3, 10, 20, 30, 0.5) + struct.pack("<Q4i", 2, 8, 0, 8, 1)
        (model / "points3D.bin").write_bytes(struct.pack("<Q", 1) + point)
        scene = read_scene(tmp_path)
        (view,) = scene.views
        assert view.name == "images/é.png"
        assert (view.camera.fx, view.camera.fy, view.camera.cx, view.camera.cy) == (50, 51, 20, 15)
        assert np.allclose(view.camera.world_to_camera[:3], [[1, 0, 0, 1], [0, -1, 0, 2], [0, 0, -1, 3]])
        assert scene.points.xyz.tolist() == [[1, 2, 3]]
        assert scene.points.rgb.tolist() == [[10, 20, 30]]

    def test_cut_short_anywhere_is_one_error(self, tmp_path):
        root = colmap_scene(tmp_path)
        for name in ("cameras.bin", "images.bin", "points3D.bin"):
            file = root / "sparse" / "0" / name
            whole = file.read_bytes()
            for size in range(len(whole)):
                file.write_bytes(whole[:size])
                with pytest.raises(LegsError, match=name):
                    read_scene(root).points  # noqa: B018
            file.write_bytes(whole + b"\0")
            with pytest.raises(LegsError, match=name):
                read_scene(root).points  # noqa: B018
            file.write_bytes(whole)
        assert len(read_scene(root).views) == 3

    def test_absurd_count_is_one_error(self, tmp_path):
        root = colmap_scene(tmp_path)
        file = root / "sparse" / "0" / "points3D.bin"
        file.write_bytes(struct.pack("<Q", 2**63) + file.read_bytes()[8:])
        with pytest.raises(LegsError, match=r"points3D\.bin"):
            read_scene(root).points  # noqa: B018

    @settings(max_examples=60, deadline=None)
    @given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1))
    def test_rotations_against_scipy(self, quaternion):
        from scipy.spatial.transform import Rotation

        w, x, y, z = quaternion
        expected = Rotation.from_quat([x, y, z, w]).as_matrix()
        assert np.allclose(colmap._rotation(quaternion), expected)
        # and back: a quaternion and its negative turn alike
        back = colmap_writer._quaternion(expected)
        assert back[0] >= 0
        assert np.allclose(np.abs(back @ quaternion), np.linalg.norm(quaternion))

    def test_what_is_written_is_read(self, tmp_path):
        generator = np.random.RandomState(0)
        cameras = {}
        for i in range(5):
            pose = np.eye(4)
            pose[:3, :3] = colmap._rotation(generator.randn(4))
            pose[:3, 3] = generator.randn(3)
            cameras[f"{i}.png"] = Camera(64, 48, 70.0 + i // 2, 71.0, 32.0, 24.0, pose)
        cloud = PointCloud(generator.randn(9, 3).astype(np.float32), generator.randint(0, 256, (9, 3)).astype(np.uint8))
        write_colmap(tmp_path, cameras, cloud)
        (tmp_path / "images").mkdir()
        scene = read_scene(tmp_path)
        for view in scene.views:
            written = cameras[view.path.name]
            assert (view.camera.fx, view.camera.fy) == (written.fx, written.fy)
            assert np.allclose(view.camera.world_to_camera, written.world_to_camera)
        assert np.array_equal(scene.points.xyz, cloud.xyz)
        assert np.array_equal(scene.points.rgb, cloud.rgb)

    def test_the_real_capture(self, fox):
        scene = read_scene(fox)
        assert len(scene.views) == 50
        assert scene.points.xyz.shape == (12817, 3)
        camera = scene.views[0].camera
        assert (camera.width, camera.height) == (354, 631)
        # Most points of a capture lie in front of each camera and within its frame.
        world = np.concatenate([scene.points.xyz, np.ones((12817, 1))], axis=1)
        x, y, z, _ = camera.world_to_camera @ world.T
        inside = (z > 0) & (np.abs(camera.fx * x / z) < 177) & (np.abs(camera.fy * y / z) < 315.5)
        assert inside.mean() > 0.2


class TestImagesFolder:
    def test_named_in_the_scene(self, tmp_path):
        root = colmap_scene(tmp_path)
        (root / "images").rename(root / "images_2")
        views = read_scene(root, images="images_2").views
        assert views[0].name == "images_2/0001.png"
        assert views[0].path.is_file()

    def test_a_path_elsewhere(self, tmp_path):
        root = colmap_scene(tmp_path / "scene")
        (root / "images").rename(tmp_path / "photos")
        views = read_scene(root, images=str(tmp_path / "photos")).views
        assert views[0].name == "photos/0001.png"
        assert views[0].path.is_file()

    def test_missing(self, tmp_path):
        root = colmap_scene(tmp_path)
        with pytest.raises(LegsError, match="images_4"):
            read_scene(root, images="images_4")

    def test_a_flattened_folder_is_found_by_the_last_part_of_the_name(self, tmp_path):
        root = colmap_scene(tmp_path, names=["cam1/x.png", "cam2/y.png"])
        (root / "images" / "cam2" / "y.png").rename(root / "images" / "y.png")
        views = read_scene(root).views
        assert [view.name for view in views] == ["images/cam1/x.png", "images/y.png"]
        assert all(view.path.is_file() for view in views)

    def test_a_missing_photograph_keeps_its_view(self, tmp_path):
        root = colmap_scene(tmp_path)
        (root / "images" / "0002.png").unlink()
        assert [view.path.is_file() for view in read_scene(root).views] == [True, False, True]


# OpenGL's camera at z = 4 that looks down at the origin.
LOOKING_DOWN = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]


def transforms(root, file="transforms.json", **contents):
    root.mkdir(parents=True, exist_ok=True)
    (root / file).write_text(json.dumps(contents))
    return root


def frame(path, **more):
    return dict({"file_path": path, "transform_matrix": LOOKING_DOWN}, **more)


class TestTransforms:
    def test_axes_and_intrinsics(self, tmp_path):
        save(tmp_path / "images" / "a.png", photograph(40, 30))
        transforms(
            tmp_path, fl_x=50, fl_y=51, cx=19, cy=16, w=40, h=30, k1=0.0, frames=[frame("images/a.png", fl_x=60)]
        )
        scene = read_scene(tmp_path)
        (view,) = scene.views
        assert (scene.kind, view.name, view.composited) == ("transforms", "images/a.png", True)
        camera = view.camera
        assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.width) == (60, 51, 19, 16, 40)
        # The origin is 4 ahead; what is up in the world is -y in the image.
        assert np.allclose(camera.world_to_camera @ [0, 0, 0, 1], [0, 0, 4, 1])
        assert np.allclose(camera.world_to_camera @ [1, 1, 0, 1], [1, -1, 4, 1])

    def test_nerf_synthetic(self, tmp_path):
        for split in ("train", "test", "val"):
            save(tmp_path / split / "r_0.png", photograph(64, 48, channels=4))
            transforms(tmp_path, f"transforms_{split}.json", camera_angle_x=np.pi / 2, frames=[frame(f"./{split}/r_0")])
        views = read_scene(tmp_path).views
        assert [(view.name, view.split) for view in views] == [
            ("test/r_0.png", "test"),
            ("train/r_0.png", "train"),
            ("val/r_0.png", "val"),
        ]
        camera = views[0].camera
        # A right angle over 64 pixels: 32 to each side at a distance of 32.
        assert (camera.width, camera.height) == (64, 48)
        assert np.allclose([camera.fx, camera.fy, camera.cx, camera.cy], [32, 32, 32, 24])

    def test_splits_of_nerfstudio(self, tmp_path):
        for name in "abc":
            save(tmp_path / "images" / f"{name}.jpg", photograph(8, 8))
        transforms(
            tmp_path,
            fl_x=9,
            w=8,
            h=8,
            train_filenames=["images/a.jpg", "./images/c.jpg"],
            test_filenames=["images/b.jpg"],
            frames=[frame(f"images/{name}.jpg") for name in "abc"],
        )
        assert [view.split for view in read_scene(tmp_path).views] == ["train", "test", "train"]

    @pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
    def test_a_byte_order_mark(self, tmp_path, encoding):
        transforms(tmp_path, fl_x=9, w=8, h=8, frames=[frame("é.png")])
        file = tmp_path / "transforms.json"
        file.write_text(file.read_text(), encoding=encoding)
        assert [view.name for view in read_scene(tmp_path).views] == ["é.png"]

    @pytest.mark.parametrize(
        ("more", "model"), [({"k1": 0.1}, "OPENCV"), ({"camera_model": "OPENCV_FISHEYE"}, "OPENCV_FISHEYE")]
    )
    def test_a_distorted_camera_keeps_its_model_name_only(self, tmp_path, more, model):
        transforms(tmp_path, fl_x=9, w=8, h=8, frames=[frame("a.png")], **more)
        (view,) = read_scene(tmp_path).views
        assert view.camera is None
        assert view.camera_model == model

    def test_a_photograph_that_is_missing_keeps_its_view(self, tmp_path):
        transforms(tmp_path, camera_angle_x=1.0, frames=[frame("./train/r_0")])
        (view,) = read_scene(tmp_path).views
        assert (view.name, view.camera) == ("train/r_0", None)

    @pytest.mark.parametrize("ending", ["png", "PNG", "JPG", "webp"])
    def test_an_ending_that_is_not_written_is_that_of_the_file(self, tmp_path, ending):
        save(tmp_path / "images" / f"a.{ending}", photograph(40, 30))
        transforms(tmp_path, camera_angle_x=1.0, frames=[frame("images/a")])
        (view,) = read_scene(tmp_path).views
        assert (view.name, view.path.is_file(), view.camera.width) == (f"images/a.{ending}", True, 40)

    @pytest.mark.parametrize(
        "text",
        [
            "{",
            "[]",
            "{}",
            '{"frames": [{}]}',
            '{"frames": [{"file_path": 3}]}',
            '{"fl_x": 1, "w": 8, "h": 8, "frames": [{"file_path": "a"}]}',
            '{"w": 8, "h": 8, "frames": [{"file_path": "a", "transform_matrix": [[1]]}]}',
            '{"fl_x": 1, "w": 8, "h": 8, "frames": [{"file_path": "a", "transform_matrix": [[1, 2], [3]]}]}',
            json.dumps({"fl_x": 1, "w": 8, "h": 8, "frames": [frame("a", transform_matrix=np.zeros((4, 4)).tolist())]}),
        ],
    )
    def test_damage_is_one_error_that_names_the_file(self, tmp_path, text):
        (tmp_path / "transforms.json").write_text(text)
        with pytest.raises(LegsError, match=r"transforms\.json"):
            read_scene(tmp_path)


class TestFolder:
    def test_images_below_but_nothing_hidden(self, tmp_path):
        for name in ("b.JPG", "a.png", "sub/Ünï cödé.webp", "x.tiff", ".hidden/c.png", ".d.png"):
            save(tmp_path / name, photograph(8, 8))
        (tmp_path / "notes.txt").write_text("no image")
        scene = read_scene(tmp_path)
        assert scene.kind == "folder"
        assert [view.name for view in scene.views] == ["a.png", "b.JPG", "sub/Ünï cödé.webp", "x.tiff"]
        assert scene.points is None

    def test_every_format_that_the_decoder_knows(self, tmp_path):
        features = pytest.importorskip("PIL.features")
        names = ["a.gif", "b.jp2", "c.tga", "d.ppm", "e.jfif"] + ["f.avif"] * features.check("avif")
        for name in names:
            save(tmp_path / name, photograph(16, 16))
        scene = read_scene(tmp_path)
        assert ([view.name for view in scene.views], scene.notes) == (names, ())
        assert [image_size(view.path) for view in scene.views] == [(16, 16)] * len(names)

    def test_what_is_not_read_is_named(self, tmp_path):
        for name in ("a.jxl", "b.NEF", "c.exr", "notes.txt", "d.pfm"):
            (tmp_path / name).write_bytes(b"")
        with pytest.raises(
            LegsError, match=r"4 file\(s\) in a format that is not read here are left out: a\.jxl, b\.NEF"
        ):
            read_scene(tmp_path)
        save(tmp_path / "e.png", photograph(8, 8))
        scene = read_scene(tmp_path)
        assert len(scene.views) == 1
        assert "left out: a.jxl, b.NEF, c.exr, d.pfm; convert" in scene.notes[0]

    def test_a_folder_named_images_is_the_scenes(self, tmp_path):
        for name in ("images/a.png", "images_2/a.png"):
            save(tmp_path / name, photograph(8, 8))
        assert [view.name for view in read_scene(tmp_path).views] == ["images/a.png"]
        assert [view.name for view in read_scene(tmp_path, "images_2").views] == ["images_2/a.png"]

    def test_nothing_to_read(self, tmp_path):
        with pytest.raises(LegsError, match="is not a scene"):
            read_scene(tmp_path)
        with pytest.raises(LegsError, match="no folder"):
            read_scene(tmp_path / "absent")
        (tmp_path / "sparse").mkdir()
        (tmp_path / "images").mkdir()
        with pytest.raises(LegsError, match=r"images\.bin"):
            read_scene(tmp_path)


def test_a_scene_that_lists_no_photograph_is_none(tmp_path):
    root = text_scene(tmp_path / "colmap")
    (root / "sparse" / "0" / "images.txt").write_text("# Number of images: 0\n")
    for scene in (root, transforms(tmp_path / "transforms", camera_angle_x=1.0, frames=[])):
        with pytest.raises(LegsError, match=r"has no photographs: its .* files list none"):
            read_scene(scene)


def test_resized_camera_sees_the_same():
    camera = Camera(400, 300, 500.0, 480.0, 210.0, 140.0, np.eye(4))
    small = camera.resized(100, 60)
    # The point in the middle of the right half of the image stays there.
    x, y = (300 - camera.cx) / camera.fx, (150 - camera.cy) / camera.fy
    assert np.allclose([small.fx * x + small.cx, small.fy * y + small.cy], [75, 30])
