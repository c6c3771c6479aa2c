"""List what torch's and Python's operations do to a value: a list for each effect.

An operation may stand in several lists: ``detach`` moves a value, and ends its gradient.
"""

from __future__ import annotations

import ast
import re
from typing import List, Set

from legs_adapters.code.module import Function
from legs_adapters.code.reaching import Reaching
from legs_adapters.code.syntax import children, path_of, word_set

# The same values: on another device, of another type or copied; where they are in range; in another order or shape.
_MOVES = word_set(
    "astype clone contiguous copy cpu cuda deepcopy detach double float half numpy requires_grad_ to type type_as"
)
LIMITS = word_set("clamp clamp_ clamp_max clamp_min clip nan_to_num round")
_AXES = word_set(
    """
    T expand expand_as flatten flip movedim permute rearrange repeat reshape reshape_as roll rot90 squeeze transpose
    unsqueeze view view_as
    """
)
_MAKES = word_set("BoolTensor FloatTensor Tensor array as_tensor asarray from_numpy tensor")  # of the same values
CONCATENATES = word_set("cat concat concatenate")  # several values as one, channel beside channel
JOINS = CONCATENATES | word_set("hstack stack vstack")
KEEPS_AXES = _MOVES | LIMITS  # every value keeps its place
LIKE = word_set("expand_as reshape_as to type_as view_as")  # uses a tensor's type or shape, not its values
ASKS = word_set("isfinite isinf isnan ones_like zeros_like")  # tests of values
CONSTANTS = word_set("full full_like ones ones_like zeros zeros_like")  # one value for every pixel
SIZES = word_set("device dim dtype is_cuda ndim numel shape size")  # properties that do not depend on the values
REDUCES = word_set("mean median std sum var")
EXTREMES = word_set("amax amin max min")
NUMBERS = word_set("bool float int len")  # Python's numbers, which are scalars
LEAVES = word_set("item numpy tolist")  # conversions of a tensor to numbers or arrays
ENDS_GRADIENT = LEAVES | {"detach"}
NO_GRAD = word_set("inference_mode no_grad")  # contexts and decorators
BACKWARD = word_set("backward manual_backward")  # the second is Lightning's
LOSSES = word_set("loss outputs tensors")  # the keywords of what they take the gradient of
LOGARITHMS = word_set("exp log log10 log1p log2")  # of a picture and back: its contours are others
TRANSFORMS = LOGARITHMS | word_set("maximum minimum pow sigmoid sqrt square tanh")  # no longer an absolute error
OTHER_LOSSES = word_set("huber_loss mse_loss norm smooth_l1_loss")
MODULES = word_set("F TF einops functional nn np numpy torch")  # as torch and its neighbours are imported
# Libraries whose operations make no other picture of one, but for the networks in them; and what hands on values.
OF_IMAGES = re.compile(
    r"(torch(?!\.hub)|torchvision(?!\.models)|kornia|numpy|PIL|cv2|skimage|scipy|einops|imageio|copy|itertools|random"
    r"|accelerate|(pytorch_)?lightning)\b"
)
LEARNED = re.compile(r"torch\.nn\.(Conv|Linear|Sequential|ModuleList|Embedding|Transformer|Multihead)")  # layers
MODULE_SELF = word_set("cpu cuda double eval float half requires_grad_ to train")  # a module's methods that return it
# These return a module wrapped; Lightning's fabric.setup, accelerate's prepare.
MODULE_WRAPS = word_set("DDP DataParallel DistributedDataParallel compile convert_sync_batchnorm fabric.setup prepare")
TRANSPARENT = word_set("autocast classmethod compile jaxtyped script staticmethod typechecked")  # decorators
HOOKS = word_set("get_loss_dict get_train_loss_dict training_step")  # a framework trains on what they return
# Words in the names of optimisers, of what steps them, and of what has a step() of another kind.
OPTIMISERS = word_set("optimiser optimisers optimizer optimizers")
STEPS = word_set("adam optim optimise optimize sgd step steps update")
SCHEDULES = word_set("bar lr pbar profiler progress sched scheduler schedulers strategy tqdm")
_PICKS = word_set("chunk index_select narrow select split unbind")
_COMPUTES = word_set("add div div_ masked_fill mean mul mul_ pow sum")
_FILTERS = word_set("abs conv2d einsum gather masked_select relu sigmoid")
_RESAMPLES = word_set("avg_pool2d center_crop crop gaussian_blur grid_sample interpolate max_pool2d pad resize")
_PASSES_ON = word_set("DataLoader checkpoint enumerate iter list next no_grad reversed tqdm tuple zip")
VIEWS = word_set("T data mT")  # attributes that are the same values
PICTURE_METHODS = KEEPS_AXES | _AXES | _PICKS | _COMPUTES | {"abs"}  # of an image, they return an image
PICTURE_FUNCTIONS = PICTURE_METHODS | _MAKES | _FILTERS | _RESAMPLES | _PASSES_ON
_MIXES = word_set("addcmul bmm lerp matmul mm where")  # an exposure, a background
KEEPS_PICTURES = PICTURE_FUNCTIONS | TRANSFORMS | _MIXES


def depends(function: Function, node: ast.AST, names: Set[str]) -> bool:
    """Return whether an expression of a function depends on the value of one of these names.

    What depends on the size alone does not.
    """
    met: Set[Reaching] = set()
    work: List[ast.AST] = [node]
    while work:
        part = work.pop()
        if isinstance(part, (ast.Name, ast.Attribute)):
            if path_of(part) in names:
                return True
            work.extend(made.value for made in function.flow.reaching(part).new(met) if made.value is not None)
        if not (isinstance(part, ast.Attribute) and part.attr in SIZES):
            work.extend(children(part))
    return False
