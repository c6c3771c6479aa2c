"""Verify a patch on the CPU: train the patched and the unpatched script, and compare the runs.

Three runs of copies of the checkout, on the embedded scene, from the same seed: unpatched, patched, and patched with
LEGS_OFF=1; of a patch with --ssim also a fourth, patched with beta 0, where nothing but the SSIM differs. Each is a
process of its own, see :mod:`legs_adapters.trace.child`.
"""

from __future__ import annotations

import math
import os
import shutil
from pathlib import Path
from typing import Callable, Dict, Iterable, List, NamedTuple, Optional, Sequence, Set

from legs_adapters.checkout.replace import locked
from legs_adapters.code.sources import check_root
from legs_adapters.journal import JOURNAL
from legs_adapters.plan import plan
from legs_adapters.shims.packages import check_imports
from legs_adapters.terms.traced import Traced
from legs_adapters.trace.child import Run, run_watched, work_folder
from legs_adapters.trace.command import SCENE, Command, filled
from legs_adapters.undo import undo
from legs_loss import LegsError

NOT_COPIED = (".git", ".legs-patch.lock", "__pycache__", "node_modules", "output", "outputs")
MAX_COPIED = 64 << 20  # bytes of a file
FIRST_STEP, LATER_STEPS = 1e-5, 1e-3  # relative differences of losses that rounding explains


class Verdict(NamedTuple):
    """The runs, and each claim with whether it holds."""

    runs: Dict[str, Run]
    claims: Dict[str, bool]

    def text(self) -> str:
        """Return the report."""
        rows = []
        for name, run in self.runs.items():
            step = "no step" if run.step is None else f"{1000 * run.step:.0f} ms a step"
            rows.append((name, f"{len(run.losses)} steps, {step}" + (f", exit code {run.code}" if run.code else "")))
        unpatched, patched = self.runs["unpatched"], self.runs.get("patched")
        if patched is not None:
            if patched.step and unpatched.step:
                ratio = patched.step / unpatched.step
                rows.append(("step", f"patched takes {ratio:.2f} times the unpatched one's time (medians)"))
            rows.append(("l1_loss", f"{patched.weighted} calls weighted, {patched.plain} plain"))
            computed = f"{patched.computed} computed; {patched.remembered} reused"
            rows.append(("maps", f"{patched.stored} from the store, {computed}"))
        rows += [("holds" if held else "FAILS", claim) for claim, held in self.claims.items()]
        rows += [(name, line) for name, run in self.runs.items() if run.code for line in run.error.splitlines()]
        return "".join(f"{name:<10} {what}\n" for name, what in rows)


def check_verifiable(
    folder: str | os.PathLike[str], script: Optional[str], arguments: Optional[str], traced: Optional[str], cpu: bool
) -> Command:
    """Return the command that trains, after checking before anything is patched that it can be run.

    Args:
        folder: the checkout.
        script: the training script in it; None: that of the traced command, the file of the one weighted term, or
            train.py.
        arguments: as for :func:`verify`.
        traced: a command that was traced.
        cpu: whether it was on the CPU: its arguments are taken over, the folders among them by their whole paths but
            those of the checkout, which its copies have.

    Raises:
        LegsError: it is ambiguous or not there, imports what is not installed, or its arguments name what is unknown.
    """
    root = check_root(folder)
    known = None if traced is None else Command.parse(root, traced)
    given = [_for_copies(root, word) for word in known.arguments] if known is not None and cpu else []
    if script is not None or known is None:
        script = script or _script(root)
        known = Command([], [script], script, [])
    if not (root / known.script).is_file():
        raise LegsError(f"there is no {known.script} in {root}")
    check_imports(root, known.script)
    filled(root / known.script, arguments, given, 1, scene=root, output=root)
    return known._replace(launcher=[], arguments=given)


def _for_copies(root: Path, word: str) -> str:
    """Return an argument for a copy of the checkout: its own folders relative, others by their whole paths."""
    option, _, value = word.rpartition("=") if word.startswith("-") else ("", "", word)
    path = (root / value).resolve()
    if root in (path, *path.parents):
        value = str(path.relative_to(root)) if os.path.isabs(value) else value
    elif path.is_dir():
        value = str(path)
    return f"{option}={value}" if option else value


def verify(
    folder: str | os.PathLike[str],
    command: Command,
    arguments: Optional[str],
    iterations: int,
    photos: Optional[str] = None,
    by_hand: bool = False,
) -> Verdict:
    """Train a patched checkout and its unpatched self on the CPU, and compare.

    Args:
        folder: the patched checkout; nothing is written there.
        command: the training script in it, and its first arguments.
        arguments: further ones, with {scene}, {output}, {iterations} and {port} filled in; None: those of Inria's
            train.py that the script's source knows.
        iterations: how many steps are compared; the script is ended then.
        photos: the folder of the photographs, of which the weighted terms are; default: those of the scene's model.
        by_hand: which terms are weighted was chosen by the user: nothing is claimed of that.

    Raises:
        LegsError: the folder is not patched any more.
    """
    from legs_loss.lab.embedded import write_embedded_scene
    from legs_loss.precompute import precompute
    from legs_loss.scenes import read_scene

    root = check_root(folder)
    runs: Dict[str, Run] = {}
    with work_folder("legs-verify-") as work:
        scene = write_embedded_scene(work / "scene", **SCENE)
        precompute(read_scene(scene), scene / "legs_weights")
        given = work / "given" / root.name
        with locked(root, f"legs-patch --verify {folder}") as stop:
            shutil.copytree(str(root), str(given), symlinks=True, ignore=lambda *at: stop() or _unneeded(*at))
        if not (given / JOURNAL).is_file():  # undone by another one, before this one had the lock
            raise LegsError(f"{root} is not patched any more: nothing to verify")
        variables: Dict[str, Dict[str, str]] = {"unpatched": {}, "patched": {}, "LEGS_OFF": {"LEGS_OFF": "1"}}
        if b"legs_loss.ssim" in (given / JOURNAL).read_bytes():
            variables["beta 0"] = {"LEGS_BETA": "0"}
        for name, settings in variables.items():
            # each its own: what one writes beside the script, the next would find
            copy = Path(shutil.copytree(str(given), str(work / name / root.name), symlinks=True))
            if name == "unpatched":
                undo(copy, force=True)
            places = {"scene": scene, "output": work / f"output-{name}"}
            more = filled(copy / command.script, arguments, command.arguments, iterations, **places)
            whole = command._replace(arguments=[*command.arguments, *more])
            runs[name] = run_watched(copy, work, whole, iterations, True, photos, settings)
            if not runs["unpatched"].losses:
                return Verdict(runs, {"the unpatched script trained": False})
    of_terms = {} if by_hand else _of_terms(Traced.read(runs["patched"].terms))
    return Verdict(runs, {**_claims(runs, by_hand), **of_terms})


def _claims(runs: Dict[str, Run], by_hand: bool) -> Dict[str, bool]:
    unpatched, patched, off = (list(runs[name].losses) for name in ("unpatched", "patched", "LEGS_OFF"))
    # Those with an L1 of a photograph under them: a step may have another backward pass, of a regulariser alone.
    known = _under(runs["unpatched"], lambda term: term.is_photometric) or {*range(1, len(unpatched) + 1)}
    weighted = _under(runs["patched"], lambda term: term.kind == "weighted")
    losses = weighted if by_hand else known
    same = {at for at, (one, other) in enumerate(zip(unpatched, patched), 1) if one == other}
    claims = {
        "all three trained": all(run.code == 0 and run.losses for run in runs.values()),
        "as many steps each": len(unpatched) == len(patched) == len(off),
        "with LEGS_OFF=1 every loss is the unpatched one, bit for bit": off == unpatched,
        "with LEGS every loss of a photograph is another": not losses & same,
        "every loss of a photograph was weighted": bool(weighted) and losses <= weighted,
        "nothing was weighted with LEGS_OFF=1": runs["LEGS_OFF"].weighted == 0,
    }
    if "beta 0" in runs:
        claim = "with beta 0 every loss is the unpatched one, up to the rounding of the SSIM"
        claims[claim] = _are_close(unpatched, runs["beta 0"].losses)
    return claims


def _under(run: Run, wanted: Callable[[Traced], bool]) -> Set[int]:
    """Return the numbers of the losses that terms lie under."""
    return set().union(*(term.passes for term in Traced.read(run.terms) if wanted(term)))


def _of_terms(terms: Iterable[Traced]) -> Dict[str, bool]:
    """Return a claim for each L1 but those of pictures of no known file: that of a photograph is weighted, no other."""
    claims: Dict[str, bool] = {}
    for term in terms:
        if term.is_l1 and (term.is_rival or not term.is_unknown):
            where = " from ".join(f"{path}:{line}" for path, line, *_ in term.frames[:2])
            claim = f"{where} is {'' if term.is_photometric else 'not '}weighted: {term.text('')}"
            claims[claim] = (term.kind == "weighted") == term.is_photometric
    return claims


def _are_close(losses: Sequence[str], others: Sequence[str]) -> bool:
    """Return whether the losses of two trainings agree: the first to rounding, which the later steps carry on."""
    bounds = [FIRST_STEP, *[LATER_STEPS] * len(losses)]
    pairs = zip(map(float.fromhex, losses), map(float.fromhex, others), bounds)
    return len(losses) == len(others) and all(math.isclose(a, b, rel_tol=bound) for a, b, bound in pairs)


def _script(root: Path) -> str:
    found = plan(root).findings
    files = sorted({site.path for site in found.sites} | {site.path for site in found.patched})
    trains = [name for name in files if b"__main__" in (root / name).read_bytes()]
    trains = trains or ["train.py"] * (root / "train.py").is_file()
    if len(trains) != 1 and "train.py" not in trains:
        raise LegsError(f"cannot tell which script trains: use --script; weighted files: {', '.join(files) or 'none'}")
    return trains[0] if len(trains) == 1 else "train.py"


def _unneeded(folder: str, names: List[str]) -> List[str]:
    """Return what is not copied: histories, caches, pipes and sockets, and anything large."""
    paths = {name: os.path.join(folder, name) for name in names if name not in NOT_COPIED}
    files = {name for name, path in paths.items() if os.path.isfile(path) and os.path.getsize(path) <= MAX_COPIED}
    return [name for name in names if name not in files and not os.path.isdir(paths.get(name, ""))]
