"""List what torch's and Python's operations do to a value: one table, a row for each effect.

An operation may stand in several rows: ``detach`` moves a value, and ends its gradient.
"""

from __future__ import annotations

from typing import Dict, FrozenSet, List, Set

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import children

_TABLE = """
moves         astype clone contiguous copy cpu cuda deepcopy detach double float half numpy requires_grad_ to type
moves         type_as
makes         BoolTensor FloatTensor Tensor array as_tensor asarray from_numpy tensor
limits        clamp clamp_ clamp_max clamp_min clip nan_to_num round
axes          T expand expand_as flatten flip movedim permute rearrange repeat reshape reshape_as roll rot90 squeeze
axes          transpose unsqueeze view view_as
picks         chunk index_select narrow select split unbind
gathers       gather masked_select
computes      add cumsum div div_ masked_fill mean mul mul_ pow sub sum
filters       abs conv2d einsum relu sigmoid
resamples     avg_pool2d center_crop crop gaussian_blur grid_sample interpolate max_pool2d pad resize
passes        DataLoader checkpoint enumerate iter list next no_grad reversed tqdm tuple zip
joins         cat concat concatenate hstack stack vstack
like          expand_as reshape_as to type_as view_as
asks          isfinite isinf isnan ones_like zeros_like
sizes         device dim dtype is_cuda ndim numel shape size
reduces       mean median std sum var
extremes      amax amin max min
numbers       bool float int len
leaves        item numpy tolist
detaches      detach
no_grad       inference_mode no_grad set_grad_enabled
backward      backward manual_backward
transforms    exp log log10 log1p log2 pow sigmoid sqrt square tanh
other_losses  huber_loss mse_loss norm smooth_l1_loss
modules       F TF einops functional nn np numpy torch
module_self   cpu cuda double eval float half requires_grad_ to train
module_wraps  DDP DataParallel DistributedDataParallel compile convert_sync_batchnorm fabric.setup prepare
everyday      clamp clone cpu cuda detach eval item mean permute reshape size squeeze step sum to train unsqueeze
everyday      forward view zero_grad
transparent   autocast classmethod compile jaxtyped script staticmethod typechecked
holders       ModuleDict OrderedDict dict functools.partial nn.ModuleDict partial torch.nn.ModuleDict
hooks         get_loss_dict get_train_loss_dict training_step
optimisers    optimiser optimisers optimizer optimizers
steps         adam optim optimise optimize sgd step steps update
schedules     bar lr pbar profiler progress sched scheduler schedulers strategy tqdm
"""


def _rows() -> Dict[str, FrozenSet[str]]:
    found: Dict[str, FrozenSet[str]] = {}
    for line in _TABLE.strip().splitlines():
        row, *names = line.split()
        found[row] = found.get(row, frozenset()).union(names)
    return found


_ROWS = _rows()
MOVES = _ROWS["moves"]  # the same values: on another device, of another type or copied
MAKES = _ROWS["makes"]  # a tensor or an array of the same values
LIMITS = _ROWS["limits"]  # the same values where they are in range
AXES = _ROWS["axes"]  # the same values in another order or shape
JOINS = _ROWS["joins"]  # several values as one
KEEPS_AXES = MOVES | LIMITS  # every value keeps its place
KEEPS_VALUES = KEEPS_AXES | MAKES | AXES | JOINS  # the values are kept, in any order
LIKE = _ROWS["like"]  # uses a tensor's type or shape, not its values
ASKS = _ROWS["asks"]  # tests of values
SIZES = _ROWS["sizes"]  # properties that do not depend on the values
REDUCES, EXTREMES = _ROWS["reduces"], _ROWS["extremes"]
NUMBERS = _ROWS["numbers"]  # Python's numbers, which are scalars
LEAVES = _ROWS["leaves"]  # conversions of a tensor to numbers or arrays
ENDS_GRADIENT = _ROWS["detaches"] | LEAVES  # these cut the gradient
NO_GRAD = _ROWS["no_grad"]  # contexts and decorators under which no gradient is kept
BACKWARD = _ROWS["backward"]  # manual_backward is Lightning's
TRANSFORMS = _ROWS["transforms"]  # the result is no longer an absolute error
OTHER_LOSSES = _ROWS["other_losses"]  # losses other than an L1
MODULES = _ROWS["modules"]  # the names under which torch and its neighbours are imported
MODULE_SELF = _ROWS["module_self"]  # methods of an nn.Module that return it
MODULE_WRAPS = _ROWS["module_wraps"]  # these return a module wrapped; Lightning's fabric.setup, accelerate's prepare
EVERYDAY = _ROWS["everyday"]  # methods of tensors, modules and optimisers: the name alone is ambiguous
TRANSPARENT = _ROWS["transparent"]  # decorators that return what the function returns
HOLDERS = _ROWS["holders"]  # containers of their arguments
HOOKS = _ROWS["hooks"]  # methods whose result a framework trains on: Lightning, nerfstudio
# Words in the names of optimisers, of what steps them, and of what has a step() of another kind.
OPTIMISERS, STEPS, SCHEDULES = _ROWS["optimisers"], _ROWS["steps"], _ROWS["schedules"]
# Operations on an image that return an image: methods, which keep, select or combine its values...
PICTURE_METHODS = KEEPS_AXES | AXES | _ROWS["picks"] | _ROWS["computes"]
# ... and functions, which also convert, filter or resize it.
PICTURE_FUNCTIONS = PICTURE_METHODS.union(
    MAKES, _ROWS["passes"], _ROWS["gathers"], _ROWS["filters"], _ROWS["resamples"]
)


def depends(function: Function, node: cst.CSTNode, names: Set[str]) -> bool:
    """Return whether an expression of a function depends on the value of one of these names, not only on its size."""
    seen: Set[int] = set()
    work: List[cst.CSTNode] = [node]
    while work:
        part = work.pop()
        if isinstance(part, cst.Name):
            if part.value in names:
                return True
            new = [d for d in function.flow.reaching(part) if id(d) not in seen]
            seen.update(id(definition) for definition in new)
            work.extend(definition.value for definition in new if definition.value is not None)
        elif not (isinstance(part, cst.Attribute) and part.attr.value in SIZES):
            work.extend(children(part))
    return False
