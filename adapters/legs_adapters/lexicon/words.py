"""The field's words, each list once: kinds of pictures, renderings and photographs, cameras, models, purposes.

A comment says where words were met, where that is not every codebase. Words are compared with those of an identifier
(``gtImage_2`` is gt, image, 2), patterns with text. What torch's operations are called stands in
``tensors/operations.py``.
"""

from __future__ import annotations

import re

from legs_adapters.code.syntax import word_set

# -- pictures

# Pictures of a view that were warped from another one (SE-GS, GaVS), which are no photographs.
WARPED = word_set("warp warped warping reproj reproject reprojected reprojection")
# The more special kinds first: a "depth image" is a depth.
WORDS = {
    # 4DGS-SLAM and SC-GS call pixels that move coor
    "flow": """
        flow flows motion motions optical velocity velocities coor coords coordinate coordinates track traj trajs
        trajectory trajectories
    """,
    "normal": "normal normals nrm",
    "depth": """
        depth depths range ranges z disp disparity disparities invdepth inverse idepth zbuf lidar distortion dist
        monodepth midas tof
    """,
    "channel": "",  # what lies behind three channels; by its index, no name says so
    # LangSplat, Feature 3DGS, Gaussian Grouping; polarised light, phasors of time-of-flight cameras
    "feature": """
        feature features feat feats semantic semantics sem language lang clip dino lseg sam embedding embeddings latent
        latents logits logit label labels identity instance codebook vgg lpips hash descriptor descriptors classes obj
        objects orientation orientations orient angle angles wavelet wavelets haar fft rfft dct phasor phasors stokes
        volume volumes voxel embed embeds
    """,
    # sds, inpaint, edit: GaussianDreamer, GaussianEditor; pseudo, unseen, virtual: codebases with few views
    "warp": f"""
        {" ".join(sorted(WARPED))} pseudo virtual unseen sds diffusion inpaint inpainted outpaint outpainted edit edited
    """,
    "gradient": "grad gradient gradients edge edges laplacian sobel curv curvature hessian canny dx dy",
    "mask": """
        mask masks alpha alphas opacity opacities silhouette sil acc accumulation seg segmentation visibility
        transmittance occupancy sky
    """,
    # of Gaussians, cameras, light and materials (GS-IR, GaussianShader), bodies and faces (GaussianAvatar)
    "parameter": """
        pointmap pointmaps scaling scalings scale scales xyz xyzs rotation rotations rot rots quat quats sh shs shn
        offset offsets grid grids plane planes pose poses deform deformation delta deltas residual means pts points
        point light lights envmap roughness metallic albedo diffuse specular material brdf camtoworld camtoworlds
        intrinsics extrinsics time entropy prior uncertainty weights audio landmark landmarks joint joints vertex
        vertices verts bone bones smpl center centers knn kpt kpts keypoint keypoints mu std base precomp radii
        timestamp timestamps
    """,
    "logarithm": "",  # by an operation; no name says so
    "image": """
        image images img imgs im ims rgb rgbs rgba color colors colour colours render renders rendered rendering
        renderings pixel pixels photo photos picture pbr comp frame frames thermal thermals
    """,
}
KINDS = tuple(WORDS)
KIND_OF = {word: kind for kind in reversed(KINDS) for word in WORDS[kind].split()}
COLORS = word_set("color colors colour colours rgb rgbs")  # of a picture, or of Gaussians
TARGET = word_set("gt gts target targets tgt ground truth original orig real true observed reference pixels")
RENDERERS = word_set("render rendering rasterize rasterization rasterizer renderer raster splat splatting")
RENDER = RENDERERS | word_set(
    """
    renders rendered renderings pred preds predict predicted prediction predictions out output outputs rets comp synth
    network student recon reconstructed reconstruction est estimated
    """
)
LAID_OVER = word_set("mask masks valid weight weights diff error errors")
# A mask, for example, unless something shows that it is an image.
OF_PICTURES = word_set("sky sh shs prior time light dx dy")
FILES = word_set("file filename name path")  # of a picture: where it is, no picture
BACKGROUND = word_set("bg bkgd background backgrounds")  # a colour to lay things over, whoever keeps it
PICKING = word_set("mask masks valid bool fg region visible hit keep inside foreground sel robust inliers")
# Of a picture, no picture.
STATISTICS = word_set("histc histogram bincount entropy gram moments grayscale gray luminance")
PERCEPTUAL = word_set("vgg perceptual lpips gram dists clip dino")
MESH = word_set("bake baked baking mesh meshhead texture")  # of triangles: what they draw is no splat
ROBUST = word_set("huber tukey cauchy")  # a weight would move their thresholds

# -- cameras, models and what optimisers move

_CAMERA = word_set("cam cams camera cameras")
CAMERAS = _CAMERA | word_set("view views viewpoint viewpoints")
DATA = CAMERAS | word_set(
    "data batch sample item items datum info infos keyframe frame dataset input inputs entry"
)  # what holds photographs
POSES = _CAMERA | word_set("pose poses so se extrinsic extrinsics camtoworld camtoworlds tracking")
EMBEDDING = word_set("embedding embeddings exposure exposures")
GAUSSIANS = word_set("gaussian gaussians gs splat splats")
TENSORS = word_set(
    """
    xyz means opacity opacities scaling scalings scales features shn anchor anchors primitives points parameters params
    variables
    """
)  # of Gaussians
MODELS = GAUSSIANS | TENSORS | word_set("model models net network mlp scene deform")
PLUMBING = word_set("torch optim adam params parameters lr name eps self")  # around what an optimiser is given

# -- purposes

LOSS = word_set("loss losses")
EVALUATING = word_set("eval evaluate evaluation evaluator test")
_SHOWING = word_set("render validate validation")
# A function's first word, where it does not train ...
NOT_TRAINING = _SHOWING | word_set("eval evaluate test inference")
# ... and any word of one through which nothing is trained.
_REPORTS = word_set("testing report reports metric metrics valid visualize vis benchmark check gradcheck")
REPORTING = EVALUATING | _SHOWING | _REPORTS | word_set("compare psnr quality")
SCORING = word_set(
    "score scores scoring importance densify densification prune pruning sensitivity sample sampling error"
)
TRACKING = word_set("tracking track tracker localize localization relocalize relocalization aligner")  # SLAM
MAPPING = word_set("mapping map mapper")  # a class that tracks and maps does not decide for its methods

# -- words in texts

# Files of Gaussian splatting, and of those the ones that cannot be about meshes.
SPLATS = re.compile(r"splat|gaussians|gaussian_?(model|render|scene|raster)|diff_\w*raster|3dgs|surfel", re.I)
DRAWS_SPLATS = re.compile(SPLATS.pattern + r"|rasteriz|render_pkg", re.I)
# Rays of a NeRF: nerfstudio's bundles, rays_o and rays_d of others, and what renders a field.
RAYS = re.compile(
    r"(?i)rays_[od]\b|ray_?bundle|ray_?samples|RaySampler|rays_valid|radiance_?field"
    r"|(octree|voxel|volume|volumetric|nerf)_?(render|raster)"
)
OF_RAYS = re.compile(r"(\b|_)(rays?|nerf|neus)(_|\b)", re.I)
STRUCTURAL = re.compile("ssim", re.I)
NO_L1 = re.compile(r"ssim|lpips|vgg|percept|psnr|mse|l2|huber|smooth_?l1|charbonnier|cross_?entropy|cosine", re.I)
# A text is searched ten times as fast where a pattern begins with a letter: what may stand before it is asked after it.
SPEAKS_OF_L1 = re.compile(r"[lL]1|abs(?<!\wabs)(?<!np\.abs)(?<!numpy\.abs)(?<!math\.abs)(?:olute)?_?\s*\(")
SPEAKS_OF_LOSS = re.compile(r"l1|mae|loss|photo|color|rgb|abs", re.I)
