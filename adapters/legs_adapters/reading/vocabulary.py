"""The field's words in names: which kind of picture a name speaks of, and whether it was rendered or photographed."""

from __future__ import annotations

from typing import Optional

from legs_adapters.reading.syntax import word_set, words

__all__ = ["DATA", "KINDS", "kind_of_words", "role_of_words"]

# The more special kinds first: a "depth image" is a depth.
_WORDS = {
    "flow": """
        flow flows motion motions optical velocity velocities coor coords coordinate coordinates track traj trajs
        trajectory trajectories
    """,
    "normal": "normal normals nrm",
    "depth": """
        depth depths disp disparity disparities invdepth inverse idepth zbuf lidar distortion dist monodepth midas tof
    """,
    "feature": """
        feature features feat feats semantic semantics sem language lang clip dino dinov2 lseg sam embedding embeddings
        latent latents logits logit label labels identity instance codebook vgg lpips hash descriptor descriptors
        classes objects wavelet wavelets haar dwt fft rfft dct census
        stokes aolp dolp phasor phasors
    """,
    "warp": """
        warp warped warping reproj reprojected reprojection pseudo virtual unseen sds diffusion inpaint inpainted
        outpaint outpainted edit edited
    """,
    "gradient": "grad gradient gradients edge edges laplacian sobel curv curvature hessian canny dx dy",
    "mask": """
        mask masks alpha alphas opacity opacities silhouette sil acc accumulation seg segmentation visibility
        transmittance occupancy sky
    """,
    "parameter": """
        scaling scalings scale scales xyz xyzs rotation rotations rot rots quat quats sh shs sh0 shn offset offsets grid
        grids plane planes pose poses deform deformation delta deltas residual means mean2d pts points point light
        lights envmap roughness metallic albedo diffuse specular material brdf camtoworld camtoworlds c2w w2c intrinsics
        extrinsics time entropy prior uncertainty weights audio landmark landmarks joint joints vertex vertices verts
        bone bones smpl center centers knn kpt kpts keypoint keypoints mu std
    """,
    "image": """
        image images img imgs im ims rgb rgbs rgba color colors colour colours render renders rendered rendering
        renderings pixel pixels photo photos picture pbr comp frame frames thermal thermals
    """,
}
KINDS = tuple(_WORDS)
_KIND_OF = {word: kind for kind in reversed(KINDS) for word in _WORDS[kind].split()}
_TARGET = word_set(
    """
    gt gts target targets tgt ground truth original orig real true observed obs reference pixels
    """
)
_RENDER = word_set(
    """
    render renders rendered rendering renderings renderer rasterize rasterizer rasterization raster pred preds
    predict predicted prediction predictions out output outputs rets comp synth synthesized splat splatting
    network student recon reconstructed reconstruction est estimated
    """
)
_LAID_OVER = word_set("mask masks valid weight weights diff error errors")
_WHICH = word_set("first second third last left right front back")  # of several of a kind
_OF_PICTURES = word_set("sky sh shs prior time dx dy")  # a mask, say, where nothing says that it is a picture
_PICTURES = {"image", "images", "img", "imgs", "photo", "photos", "frame", "frames"}
_LIT_BY = {"light", "lights"}
_OF_ONE = word_set("scale scales scaling scalings offset offsets center centers mean light lights")  # scaled or shifted
_HELD_IN = word_set("tensor tensors t batch np torch cuda gpu list map maps full")
DATA = word_set(
    """
    data batch sample item items datum cam camera cameras cams view views viewpoint viewpoints info infos
    keyframe frame dataset input inputs entry
    """
)


def kind_of_words(name: str) -> Optional[str]:
    """Return the kind that a name speaks of; the more special where it has several."""
    spoken = words(name)
    if "and" in spoken:  # of what image_and_depth holds the one is no depth, the other no image
        at = spoken.index("and")
        both = {kind_of_words("_".join(part)) for part in (spoken[:at], spoken[at + 1 :])}
        if "image" in both and len(both - {None}) > 1:
            return None
    if "no" in spoken[1:]:  # image_no_sh
        spoken = spoken[: spoken.index("no", 1)]
    said = [word for word in spoken if not word.isdigit() and word not in _HELD_IN | _WHICH]
    if said and said[-1] in _LAID_OVER:
        return "mask"  # of whatever: laid over an image, it leaves an image
    kinds = {_KIND_OF[word] for word in spoken if word in _KIND_OF}
    if "image" in kinds:  # sky_rgb, render_sh
        if spoken[-1] in _LIT_BY and "image" in spoken and _TARGET.intersection(spoken):
            spoken = spoken[:-1]  # original_image_train_light
        if spoken[-1] in _PICTURES:
            spoken = tuple(word for word in spoken if word not in _OF_ONE)  # offset_image, not image_offset
        kinds = {_KIND_OF[word] for word in spoken if word in _KIND_OF and word not in _OF_PICTURES}
        if "base" in spoken or "precomp" in spoken:  # rendered_base_color; colors_precomp, a colour for each Gaussian
            return "parameter"
    return min(kinds, key=KINDS.index) if kinds else None


def role_of_words(name: str) -> Optional[str]:
    """Return the role that a name speaks of, if it speaks of one."""
    found = set(words(name))
    target, render = bool(found & _TARGET), bool(found & _RENDER)
    if target and render:  # rendered_gt, gt_pred: only a closer look can tell
        return None
    return "target" if target else "render" if render else None
