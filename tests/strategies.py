"""Random images for the property tests."""

from __future__ import annotations

import torch
from hypothesis import strategies as st


@st.composite
def images(draw, max_side=24, channels=(1, 2, 3, 4)):
    """Draw a float64 image [C, H, W] in [0, 1]: noise, steps, or mostly flat; sides down to one pixel."""
    shape = (draw(st.sampled_from(channels)), draw(st.integers(1, max_side)), draw(st.integers(1, max_side)))
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**31 - 1)))
    image = torch.rand(shape, generator=generator, dtype=torch.float64)
    kind = draw(st.sampled_from(["noise", "steps", "flat"]))
    if kind == "steps":
        image = (image * 4).floor() / 4
    elif kind == "flat":
        image = torch.where(image > 0.95, image, torch.full_like(image, 0.5))
    return image
