"""The loss of a training step as a script calls it: its own l1_loss and ssim, and the drop-ins in their place.

    python benchmarks/drop_in.py --threads 1 --size 1297x840

Forward and backward, in turns on the same eight pairs of images. "3DGS" is Inria's: |a - b|.mean() and torch's SSIM.
Nothing is stored; a kept map is one that the script holds itself. Writes JSON.
"""

from __future__ import annotations

import argparse
import json

import torch
from losses.contenders import LAMBDA, LEGS, Contenders, reference_ssim
from losses.images import Pairs, in_turns, some_images
from losses.machine import machine
from losses.tables import side_by_side
from torch import Tensor

from legs_loss import configure, l1_loss, ssim, weight_map


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="1297x840", type=lambda text: tuple(int(side) for side in text.split("x")))
    parser.add_argument("--device", type=torch.device, default=torch.device("cpu"), help="cpu (the default) or cuda")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--json", help="write everything to this file")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    configure("legs")
    pairs = some_images(args.size, args.device)
    print(f"\nforward and backward, {args.size[0]}x{args.size[1]} RGB, {args.threads} thread(s), {args.device}")
    result = {
        "machine": machine(args.device),
        "threads": args.threads,
        "size": f"{args.size[0]}x{args.size[1]}",
        "l1": side_by_side(terms(pairs), args.rounds, "l1_loss", args.device),
        "step": side_by_side(steps(pairs), args.rounds, "l1_loss and ssim", args.device),
    }
    if args.json:
        with open(args.json, "w", encoding="utf-8") as file:
            json.dump(result, file, indent=1)
            file.write("\n")


def terms(pairs: Pairs) -> Contenders:
    """Return the L1 term alone."""
    kept = [weight_map(target, LEGS) for _, target in pairs]
    return {
        "l1_loss": in_turns(pairs, lambda image, target, i: l1_loss(image, target)),
        "3DGS's l1_loss (torch)": in_turns(pairs, lambda image, target, i: torch.abs(image - target).mean()),
        "a kept map by torch": in_turns(pairs, lambda image, target, i: (kept[i] * torch.abs(image - target)).mean()),
    }


def steps(pairs: Pairs) -> Contenders:
    """Return the loss of a step."""

    def mixed(l1: Tensor, similarity: Tensor) -> Tensor:
        return (1.0 - LAMBDA) * l1 + LAMBDA * (1.0 - similarity)

    def plain(image: Tensor, target: Tensor) -> Tensor:
        return torch.abs(image - target).mean()

    return {
        "l1_loss and ssim": in_turns(pairs, lambda a, b, i: mixed(l1_loss(a, b), ssim(a, b))),
        "l1_loss, 3DGS's ssim (torch)": in_turns(pairs, lambda a, b, i: mixed(l1_loss(a, b), reference_ssim(a, b))),
        "3DGS's both (torch)": in_turns(pairs, lambda a, b, i: mixed(plain(a, b), reference_ssim(a, b))),
    }


if __name__ == "__main__":
    main()
