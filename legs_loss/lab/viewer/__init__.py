"""``legs view``: trained Gaussians in the browser, methods beside each other, and the cameras."""

from __future__ import annotations
