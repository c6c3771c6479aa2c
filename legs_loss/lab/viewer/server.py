"""The page: a viser server with the methods' splats, switches, a slider between two of them, and the cameras."""

from __future__ import annotations

import io
import re
import sys
import time
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any, Dict, NamedTuple, Tuple

import numpy as np

from legs_loss.errors import LegsError, require
from legs_loss.lab.conventions import SH_C0
from legs_loss.lab.gaussians import Gaussians, rotations
from legs_loss.lab.ply import read_ply
from legs_loss.lab.training.dataset import dimmed, open_store
from legs_loss.lab.viewer.content import Content
from legs_loss.lab.viewer.guard import Guard, check_address
from legs_loss.scenes import View, image_tensor, load_training_image
from legs_loss.scenes.user_maps import averaged
from legs_loss.spec import as_spec
from legs_loss.store import MASK
from legs_loss.system.terminal import say

_CAMERAS = 40  # shown at most, spread evenly
_PICTURE = 160  # pixels: the width of a camera's picture
_WIPE_SECONDS = 0.15
_FARTHEST = 1e9
_LARGEST = float(np.finfo(np.float16).max)  # viser sends covariances as float16


class Drawable(NamedTuple):
    """Arguments of viser, float32: centers [N, 3], covariances [N, 3, 3], rgbs [N, 3], opacities [N, 1] in [0, 1]."""

    centers: np.ndarray
    covariances: np.ndarray
    rgbs: np.ndarray
    opacities: np.ndarray


def splats(gaussians: Gaussians) -> Drawable:
    """Return Gaussians for viser. Colours are of degree 0: they do not depend on the direction.

    Those that are nowhere, or too far or too large to be drawn (infinite in float16), are left out.
    """
    axes = rotations(gaussians.quaternions) * gaussians.scales[:, None, :]
    colours = (0.5 + SH_C0 * gaussians.sh[:, 0]).clamp(0, 1)
    parts = (gaussians.means, axes @ axes.transpose(1, 2), colours, gaussians.opacities)
    found = [part.detach().float().numpy() for part in parts]
    drawn = np.abs(found[0]).max(axis=1) < _FARTHEST
    for part in found[1:]:
        drawn &= np.abs(part).reshape(len(part), -1).max(axis=1) < _LARGEST  # of NaN, too, this is false
    return Drawable(*(part[drawn] for part in found))


def left_of(
    centers: np.ndarray, rotation: np.ndarray, position: np.ndarray, fov: float, aspect: float, share: float
) -> np.ndarray:
    """Return which points lie left of a vertical line on the screen, bool [N].

    Args:
        centers: [N, 3].
        rotation: [3, 3], of the camera's axes (x right, y down, z forward) in the world.
        position: of the camera, [3].
        fov: vertical, in radians.
        aspect: width by height.
        share: of the screen's width that is left of the line, in [0, 1].

    Examples:
        >>> points = np.array([[-1.0, 0.0, 2.0], [1.0, 0.0, 2.0]])
        >>> left_of(points, np.eye(3), np.zeros(3), 1.0, 1.0, 0.5).tolist()
        [True, False]
    """
    seen = (centers - position) @ rotation
    edge = (2 * share - 1) * np.tan(fov / 2) * aspect
    return seen[:, 0] < edge * np.maximum(seen[:, 2], 1e-6)


def serve(content: Content, preset: str = "legs", host: str = "127.0.0.1", port: int = 8080) -> Tuple[Any, str]:
    """Start the server; return it and the address to open. It runs in threads of its own until it is stopped.

    Args:
        content: from :func:`~legs_loss.lab.viewer.content.find_content`.
        preset: whose weight maps the cameras show.
        host, port: where it listens; the next free port is taken if this one is in use.

    Raises:
        LegsError: viser is missing, a .ply cannot be read or has no Gaussian that can be drawn, or the address is none
            of this machine's.
    """
    check_address(host, port)
    loaded = {name: _read(path) for name, path in content.methods.items()}
    server, address = _start(host, port)
    # A folder may be named by a stranger: viser loads pictures that text names, and older ones run what is in braces.
    title = re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", " ".join(content.title.split()))
    server.gui.add_markdown(f"### {title}")
    _Methods(server, loaded)
    _add_dark_mode(server)
    if content.scene is not None:
        _Cameras(server, content, preset)
    else:
        _look_at_all(server, loaded)
    return server, address


def _read(path: Path) -> Drawable:
    """Read a .ply's Gaussians for viser; say how many of them are left out."""
    gaussians = read_ply(path)
    drawn = splats(gaussians)
    left = len(gaussians) - len(drawn.centers)
    why = "not finite, or too far or too large to be drawn"
    if not len(drawn.centers):
        raise LegsError(f"{path}: none of its {len(gaussians):,} Gaussians can be shown: {why}")
    if left:
        say(f"legs: {path}: {left:,} of {len(gaussians):,} Gaussians are left out: {why}", sys.stderr)
    return drawn


def _start(host: str, port: int) -> Tuple[Any, str]:
    """Start an empty server that answers the address returned and nothing else."""
    require("legs view", "view", "viser")
    import viser

    class Unshared(viser.ViserServer):
        """viser without its public tunnel, for which any client may ask."""

        def request_share_url(self, verbose: bool = True) -> None:
            """Share nothing."""

    guard = Guard(host)
    with guard.before_every_handshake(), redirect_stdout(io.StringIO()):  # viser prints an address without the token
        server = Unshared(host=host, port=port, verbose=False)
    if not guard.on:
        server.stop()
        raise LegsError(f"viser {viser.__version__} would answer requests of any page: pip install --upgrade viser")
    return server, guard.address(server.get_port())


def _add_dark_mode(server: Any) -> None:
    dark = server.gui.add_checkbox("dark", initial_value=False)

    def apply() -> None:
        server.gui.configure_theme(control_layout="collapsible", dark_mode=dark.value, show_share_button=False)

    dark.on_update(lambda _: apply())
    apply()


class _Methods:
    """The splats of each method: shown or not, or two of them on either side of a line."""

    def __init__(self, server: Any, loaded: Dict[str, Drawable]) -> None:
        self.server, self.loaded = server, loaded
        names = list(loaded)
        self.handles = {
            name: server.scene.add_gaussian_splats(f"/methods/{name}", **one._asdict(), visible=name == names[0])
            for name, one in loaded.items()
        }
        self.shown: Dict[str, Any] = {}
        for name in names:
            count = f"{len(loaded[name].centers):,} Gaussians"
            box = server.gui.add_checkbox(f"{name}: {count}", initial_value=name == names[0])
            box.on_update(lambda event: self.draw(event.client))
            self.shown[name] = box
        self.wiping = None
        self.wiped_at = 0.0
        if len(names) > 1:
            with server.gui.add_folder("Wipe"):
                self.wiping = server.gui.add_checkbox("wipe between two", initial_value=False)
                left, right = ("3dgs", "legs") if {"3dgs", "legs"} <= set(names) else (names[0], names[-1])
                self.left = server.gui.add_dropdown("left", names, initial_value=left)
                self.right = server.gui.add_dropdown("right", names, initial_value=right)
                self.share = server.gui.add_slider("line", min=0.0, max=1.0, step=0.01, initial_value=0.5)
            for control in (self.wiping, self.left, self.right, self.share):
                control.on_update(lambda event: self.draw(event.client))
            server.on_client_connect(lambda client: client.camera.on_update(lambda _: self.follow(client)))

    def follow(self, client: Any) -> None:
        """Keep the line where it is on the screen while the camera moves."""
        if self.wiping is not None and self.wiping.value and time.monotonic() - self.wiped_at > _WIPE_SECONDS:
            self.draw(client)

    def draw(self, client: Any) -> None:
        """Show the selected methods."""
        wiping = self.wiping is not None and self.wiping.value and client is not None
        sides = {self.left.value: True, self.right.value: False} if wiping else {}
        with self.server.atomic():
            for name, handle in self.handles.items():
                handle.visible = name in sides if wiping else self.shown[name].value
                if name in sides:
                    self._cut(client, name, sides[name])
                elif self.wiped_at:
                    handle.opacities = self.loaded[name].opacities
        self.wiped_at = time.monotonic() if wiping else self.wiped_at

    def _cut(self, client: Any, name: str, keeps_left: bool) -> None:
        from viser.transforms import SO3

        one, camera = self.loaded[name], client.camera
        left = left_of(
            one.centers, SO3(camera.wxyz).as_matrix(), camera.position, camera.fov, camera.aspect, self.share.value
        )
        self.handles[name].opacities = one.opacities * (left == keeps_left)[:, None]


class _Cameras:
    """The scene's cameras as frustums, with the photograph or the weight map in each."""

    def __init__(self, server: Any, content: Content, preset: str) -> None:
        assert content.scene is not None
        with_camera = [view for view in content.scene.views if view.camera is not None]
        step = max(1, -(-len(with_camera) // _CAMERAS))
        self.content, self.spec, self.views = content, as_spec(preset), with_camera[::step]
        self.levels: Any = None
        self.store = open_store(content.scene)
        self.masks = {entry.view: entry for entry in self.store.of_kind(MASK)} if self.store is not None else {}
        poses = [_pose(view) for view in self.views]
        size = 0.03 * float(np.ptp([position for _, position in poses], axis=0).max()) if len(poses) > 1 else 0.1
        self.handles = [self._add(server, view, *pose, size or 0.1) for view, pose in zip(self.views, poses)]
        self.what = server.gui.add_dropdown(
            "cameras", ["none", "outlines", "photograph", "weight map"], initial_value="none"
        )
        self.what.on_update(lambda _: self.draw())
        self.pictures: Dict[Tuple[str, str], np.ndarray] = {}
        if poses:
            _start_at(server, *poses[0], np.mean([rotation[:, 1] for rotation, _ in poses], axis=0))

    def _add(self, server: Any, view: View, rotation: np.ndarray, position: np.ndarray, size: float) -> Any:
        from viser.transforms import SO3

        camera = view.camera
        assert camera is not None
        handle = server.scene.add_camera_frustum(
            f"/cameras/{view.name}",
            fov=2 * np.arctan(camera.height / (2 * camera.fy)),
            aspect=camera.width / camera.height,
            scale=size,
            wxyz=SO3.from_matrix(rotation).wxyz,
            position=position,
            visible=False,
        )
        handle.on_click(lambda event: _look_through(event.client, handle.wxyz, position))
        return handle

    def draw(self) -> None:
        """Show the selection of the dropdown."""
        for view, handle in zip(self.views, self.handles):
            handle.visible = self.what.value != "none"
            handle.image = self._picture(view) if self.what.value in ("photograph", "weight map") else None

    def _picture(self, view: View) -> Any:
        key = self.what.value, view.name
        if key not in self.pictures:
            try:
                self.pictures[key] = self._weight(view) if key[0] == "weight map" else self._photograph(view)
            except LegsError:
                return None  # the photograph is missing: the outline stays
        return self.pictures[key]

    def _photograph(self, view: View) -> np.ndarray:
        """Return a photograph, darkened where its mask leaves it out, uint8 [H, W, 3]."""
        image, mask = _image(view).expand(3, -1, -1).numpy(), None
        if view.name in self.masks and self.store is not None:
            mask = averaged(self.store.user_map(self.masks[view.name]), image.shape[:0:-1])
        return (dimmed(image, mask).transpose(1, 2, 0) * 255).round().astype(np.uint8)

    def _weight(self, view: View) -> np.ndarray:
        """Return a weight map from black (1) to white (1 + beta), uint8 [H, W, 3]."""
        from legs_loss.precompute.photograph import levels_of
        from legs_loss.weights import weight_map

        if self.levels is None:  # of the views that are shown; None again where the preset needs none
            self.levels = levels_of(map(_image, self.views), self.spec)
        gray = (weight_map(_image(view), self.spec, scene=self.levels)[0].numpy() - 1) / max(self.spec.beta, 1e-6)
        return np.repeat((gray.clip(0, 1) * 255).round().astype(np.uint8)[..., None], 3, axis=2)


def _image(view: View) -> Any:
    return image_tensor(load_training_image(view, _PICTURE))


def _pose(view: View) -> Tuple[np.ndarray, np.ndarray]:
    """Return a camera's axes in the world [3, 3], and its position [3]."""
    assert view.camera is not None
    rotation = view.camera.world_to_camera[:3, :3].T
    return rotation, -rotation @ view.camera.world_to_camera[:3, 3]


def _start_at(server: Any, rotation: np.ndarray, position: np.ndarray, down: np.ndarray) -> None:
    from viser.transforms import SO3

    server.scene.set_up_direction(tuple(-down / max(float(np.linalg.norm(down)), 1e-6)))
    wxyz = SO3.from_matrix(rotation).wxyz
    server.on_client_connect(lambda client: _look_through(client, wxyz, position))


def _look_through(client: Any, wxyz: np.ndarray, position: np.ndarray) -> None:
    if client is not None:
        with client.atomic():
            client.camera.wxyz, client.camera.position = wxyz, position


def _look_at_all(server: Any, loaded: Dict[str, Drawable]) -> None:
    """Look from outside towards the middle of what is opaque, where there are no cameras."""
    points = np.concatenate([one.centers[one.opacities[:, 0] > 0.1] for one in loaded.values()])
    if not len(points):
        return
    low, middle, high = (np.percentile(points, at, axis=0) for at in (5, 50, 95))
    place = middle + np.array([0.0, -0.4, -1.2]) * max(float((high - low).max()), 1e-3)
    server.scene.set_up_direction("-y")

    def look(client: Any) -> None:
        with client.atomic():
            client.camera.position, client.camera.look_at = place, middle

    server.on_client_connect(look)
