"""The LEGS paper's main table, measured: 3DGS, FastGS and FasterGS with and without the loss, on its two datasets.

    python reproduce.py --inria gaussian-splatting --fastgs FastGS --nerficg nerficg --data datasets --dry-run

DATA holds tanksandtemples/{truck,train} and mipnerf360/{bicycle,...}. Each codebase and scene is one run of
compare.py, with the codebase's own official settings: the four losses, LEGS's maps of mean 1, and the unweighted
codebase at LEGS's number of Gaussians, over several seeds. The paper scores training views: this scores them and those
held out.
The same command goes on after an interruption. --dry-run prints every command and runs none.
"""

from __future__ import annotations

import argparse
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import List

DATASETS = {
    "tanksandtemples": ["truck", "train"],
    "mipnerf360": ["bicycle", "flowers", "garden", "stump", "treehill", "room", "counter", "kitchen", "bonsai"],
}
INDOOR = ("room", "counter", "kitchen", "bonsai")


def main() -> int:
    """Run, or print, one comparison a codebase and scene; return the first exit code that is not 0."""
    args = arguments()
    for profile, root in (("3dgs", args.inria), ("fastgs", args.fastgs), ("fastergs", args.nerficg)):
        if root is None:
            continue
        for dataset, names in DATASETS.items():
            for name in names:
                if args.scenes is None or name in args.scenes:
                    words = command(args, profile, root, dataset, name)
                    print(" ".join(map(shlex.quote, words)), flush=True)
                    code = 0 if args.dry_run else subprocess.run(words).returncode
                    if code != 0:
                        return code
    return 0


def arguments() -> argparse.Namespace:
    """Read the command line."""
    summary, _, rest = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(description=summary, epilog=rest, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--inria", type=Path, metavar="DIR", help="a checkout of graphdeco-inria/gaussian-splatting")
    parser.add_argument("--fastgs", type=Path, metavar="DIR", help="a checkout of fastgs/FastGS")
    parser.add_argument("--nerficg", type=Path, metavar="DIR", help="a checkout of NeRFICG with FasterGS in it")
    parser.add_argument(
        "--data", type=Path, required=True, metavar="DIR", help="the folder of tanksandtemples/ and mipnerf360/"
    )
    names = [name for scenes in DATASETS.values() for name in scenes]
    parser.add_argument("--scenes", nargs="+", choices=names, metavar="NAME", help="of the datasets; default: all")
    parser.add_argument("--seeds", type=int, default=3, metavar="N", help="of each arm; default: 3")
    parser.add_argument("--out", type=Path, default=Path("reproduced"), metavar="DIR", help="default: reproduced")
    parser.add_argument("--dry-run", action="store_true", help="print every command, run none")
    args = parser.parse_args()
    if not (args.inria or args.fastgs or args.nerficg):
        parser.error("name at least one checkout: --inria, --fastgs, --nerficg")
    return args


def command(args: argparse.Namespace, profile: str, root: Path, dataset: str, name: str) -> List[str]:
    """Return the comparison of a codebase on a scene, with the settings that its authors give for that scene."""
    words = [sys.executable, str(Path(__file__).with_name("compare.py")), str(args.data / dataset / name), str(root)]
    words += ["--profile", profile, "--seeds", str(args.seeds)]
    words += ["-m", str(args.out / profile / name)]
    extra: List[str] = []
    if profile == "3dgs" and dataset == "mipnerf360":  # as its full_eval.py
        words += ["--images", "images_2" if name in INDOOR else "images_4"]
    elif profile == "fastgs":
        extra = fastgs_settings(root, dataset, name)
        if "-i" in extra:
            at = extra.index("-i")
            words += ["--images", extra[at + 1]]
            del extra[at : at + 2]
    elif profile == "fastergs" and dataset == "mipnerf360":
        words += ["-r", "2" if name in INDOOR else "4"]
    return words + (["--extra=" + " ".join(map(shlex.quote, extra))] if extra else [])


def fastgs_settings(root: Path, dataset: str, name: str) -> List[str]:
    """Return what the checkout's train_base.sh gives a scene, after its -s and -m; --eval is given anyway."""
    script = root / "train_base.sh"
    text = script.read_text(encoding="utf-8") if script.is_file() else ""
    found = re.search(rf"python train\.py -s \S*/{dataset}/{name}\s+(?:-m \S+\s*)?(.*)", text)
    return [word for word in shlex.split(found.group(1)) if word != "--eval"] if found else []


if __name__ == "__main__":
    sys.exit(main())
