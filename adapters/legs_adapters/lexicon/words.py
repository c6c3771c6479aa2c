"""The field's words: those that name a kind of picture, a rendering, a photograph, what holds them."""

from __future__ import annotations

from legs_adapters.code.syntax import word_set

__all__ = [
    "DATA",
    "HELD_IN",
    "KINDS",
    "KIND_OF",
    "LAID_OVER",
    "LIT_BY",
    "OF_ONE",
    "OF_PICTURES",
    "PICTURES",
    "RENDER",
    "RENDERERS",
    "TARGET",
    "WHICH",
    "WORDS",
]

# The more special kinds first: a "depth image" is a depth.
WORDS = {
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
KINDS = tuple(WORDS)
KIND_OF = {word: kind for kind in reversed(KINDS) for word in WORDS[kind].split()}
TARGET = word_set(
    """
    gt gts target targets tgt ground truth original orig real true observed obs reference pixels
    """
)
RENDER = word_set(
    """
    render renders rendered rendering renderings renderer rasterize rasterizer rasterization raster pred preds
    predict predicted prediction predictions out output outputs rets comp synth synthesized splat splatting
    network student recon reconstructed reconstruction est estimated
    """
)
LAID_OVER = word_set("mask masks valid weight weights diff error errors")
WHICH = word_set("first second third last left right front back")  # of several of a kind
OF_PICTURES = word_set("sky sh shs prior time dx dy")  # a mask, say, where nothing says that it is a picture
PICTURES = {"image", "images", "img", "imgs", "photo", "photos", "frame", "frames"}
LIT_BY = {"light", "lights"}
OF_ONE = word_set("scale scales scaling scalings offset offsets center centers mean light lights")  # scaled or shifted
HELD_IN = word_set("tensor tensors t batch np torch cuda gpu list map maps full")
DATA = word_set(
    """
    data batch sample item items datum cam camera cameras cams view views viewpoint viewpoints info infos
    keyframe frame dataset input inputs entry
    """
)
RENDERERS = {
    "render", "rendering", "rasterize", "rasterization", "rasterizer", "renderer", "raster", "splat", "splatting",
}  # fmt: skip
