"""Ways to train, as bodies of tests/patcher/traced.py's train.py; the line that is the loss is marked."""

from __future__ import annotations

__all__ = ["UNSEEN", "WAYS"]

STEP = """
    loss.backward()
    splats.optimizer.step()
    splats.optimizer.zero_grad()
"""
VIEW = """
    camera = views[step % len(views)]
    gt_image = camera.values["images"]
    image = splats.draw(camera)["rgb"]
"""
LOOP = "\nfor step in range(100):" + VIEW

ACCUMULATED = """
for step in range(300):
    camera = views[step % len(views)]
    image = splats.draw(camera)["rgb"]
    loss = F.l1_loss(image, camera.values["images"]) / 3  # <- here
    loss.backward()
    if step % 3 == 2:
        splats.optimizer.step()
        splats.optimizer.zero_grad()
"""

SEVERAL = (
    LOOP
    + """
    colour = F.l1_loss(image, gt_image)  # <- here
    depth = (splats.draw(camera)["depth"] - gt_image[:1]).abs().mean()
    colour.backward()
    depth.backward()
    splats.optimizer.step()
    splats.optimizer.zero_grad()
"""
)

OF_GRAD = (
    LOOP
    + """
    loss = F.l1_loss(image, gt_image)  # <- here
    leaves = [splats.xy, splats.colour, splats.opacity]
    for leaf, gradient in zip(leaves, torch.autograd.grad(loss, leaves)):
        leaf.grad = gradient
    splats.optimizer.step()
"""
)

OF_FUNCTION = "\ndef objective(image, gt_image):\n    return F.l1_loss(image, gt_image)  # <- here\n" + OF_GRAD.replace(
    "F.l1_loss(image, gt_image)  # <- here", "objective(image, gt_image)"
)

DESCENT = (
    LOOP
    + """
    loss = F.l1_loss(image, gt_image)  # <- here
    leaves = [splats.xy, splats.colour, splats.opacity]
    gradients = torch.autograd.grad(loss, leaves)
    with torch.no_grad():
        for leaf, gradient in zip(leaves, gradients):
            leaf -= 0.01 * gradient
"""
)

AUTOCAST = (
    LOOP
    + """
    with torch.autocast("cpu", dtype=torch.bfloat16):
        loss = F.l1_loss(image, gt_image)  # <- here
"""
    + STEP
)

ACCELERATE = """
from accelerate import Accelerator

accelerator = Accelerator(cpu=True, gradient_accumulation_steps=2)
optimizer = accelerator.prepare(splats.optimizer)
for step in range(100):
    with accelerator.accumulate(torch.nn.Linear(1, 1)):
        camera = views[step % len(views)]
        image = splats.draw(camera)["rgb"]
        loss = F.l1_loss(image, camera.values["images"].to(accelerator.device))  # <- here
        accelerator.backward(loss)
        optimizer.step()
        optimizer.zero_grad()
"""

LIGHTNING = """
from lightning import LightningModule, Trainer


class Model(LightningModule):
    def __init__(self):
        super().__init__()
        self.leaves = torch.nn.ParameterList([splats.xy, splats.colour, splats.opacity])

    def training_step(self, batch, index):
        camera = views[int(batch)]
        return F.l1_loss(splats.draw(camera)["rgb"], camera.values["images"])  # <- here

    def configure_optimizers(self):
        return splats.optimizer


silent = dict(logger=False, enable_checkpointing=False, enable_progress_bar=False)
trainer = Trainer(max_steps=100, accelerator="cpu", accumulate_grad_batches=2, **silent)
trainer.fit(Model(), torch.utils.data.DataLoader(list(range(6)), batch_size=1))
"""

BY_HAND = LIGHTNING.replace(
    '        return F.l1_loss(splats.draw(camera)["rgb"], camera.values["images"])  # <- here\n',
    """        optimizer = self.optimizers()
        loss = F.l1_loss(splats.draw(camera)["rgb"], camera.values["images"])  # <- here
        optimizer.zero_grad()
        self.manual_backward(loss)
        optimizer.step()
""",
).replace("super().__init__()", "super().__init__()\n        self.automatic_optimization = False")
BY_HAND = BY_HAND.replace("accumulate_grad_batches=2, ", "")

FABRIC = """
from lightning.fabric import Fabric

fabric = Fabric(accelerator="cpu", devices=1)
fabric.launch()
_, optimizer = fabric.setup(torch.nn.ParameterList([splats.xy, splats.colour, splats.opacity]), splats.optimizer)
for step in range(100):
    camera = views[step % len(views)]
    loss = F.l1_loss(splats.draw(camera)["rgb"], camera.values["images"])  # <- here
    fabric.backward(loss)
    optimizer.step()
    optimizer.zero_grad()
"""

WORKERS = """
class Views(torch.utils.data.Dataset):
    def __len__(self):
        return len(views)

    def __getitem__(self, index):
        return index, views[index].values["images"] - torch.zeros(3, 1, 1)


if __name__ == "__main__":
    loader = torch.utils.data.DataLoader(Views(), num_workers=2, multiprocessing_context="CONTEXT")
    for _ in range(20):
        for index, gt_image in loader:
            loss = F.l1_loss(splats.draw(views[int(index)])["rgb"][None], gt_image)  # <- here
            loss.backward()
            splats.optimizer.step()
            splats.optimizer.zero_grad()
"""

MODEL = """
class Model(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.leaves = torch.nn.ParameterList([splats.xy, splats.colour, splats.opacity])

    def forward(self, camera):
        return splats.draw(camera)["rgb"]


def train(rank):
    model = torch.nn.parallel.DistributedDataParallel(Model())
    for step in range(100):
        camera = views[(2 * step + rank) % len(views)]
        loss = F.l1_loss(model(camera), camera.values["images"])  # <- here
        loss.backward()
        splats.optimizer.step()
        splats.optimizer.zero_grad()
"""

TORCHRUN = (
    MODEL
    + """

torch.distributed.init_process_group("gloo")
train(torch.distributed.get_rank())
"""
)

SPAWNED = (
    MODEL
    + """

def work(rank, file):
    torch.distributed.init_process_group("gloo", init_method=f"file://{file}", rank=rank, world_size=2)
    train(rank)


if __name__ == "__main__":
    import tempfile

    torch.multiprocessing.spawn(work, (tempfile.mktemp(),), nprocs=2)
"""
)

COMPARED = """
def compare(a, b):
    return (a - b).abs().mean()


compare = torch.compile(compare, backend="aot_eager", fullgraph=True)
"""

COMPILED = COMPARED + LOOP + "    loss = compare(image, gt_image)  # <- here" + STEP
SCRIPTED = COMPILED.replace('torch.compile(compare, backend="aot_eager", fullgraph=True)', "torch.jit.script(compare)")
SCRIPTED = SCRIPTED.replace(
    "(a - b).abs().mean()", "F.l1_loss(a, b)"
)  # can be edited, but TorchScript does not know ours

FUSED = (
    """
class Fused(torch.autograd.Function):
    @staticmethod
    def forward(ctx, a, b):
        ctx.save_for_backward(a, b)
        return (a - b).abs().mean()

    @staticmethod
    def backward(ctx, gradient):
        a, b = ctx.saved_tensors
        return gradient * torch.sign(a - b) / a.numel(), None

"""
    + LOOP
    + "    loss = Fused.apply(image, gt_image)  # <- here"
    + STEP
)

CHECKPOINTED = (
    """
from torch.utils.checkpoint import checkpoint

"""
    + LOOP.replace("splats.draw(camera)", "checkpoint(splats.draw, camera, use_reentrant=False)")
    + "    loss = F.l1_loss(image, gt_image)  # <- here"
    + STEP
)

# By name: the script, and the modules that it needs.
WAYS = {
    "gradients accumulated over steps": (ACCUMULATED, []),
    "several backward passes a step": (SEVERAL, []),
    "autograd.grad": (OF_GRAD, []),
    "autograd.grad of a function": (OF_FUNCTION, []),
    "autograd.grad, stepped by hand": (DESCENT, []),
    "autocast": (AUTOCAST, []),
    "checkpointing": (CHECKPOINTED, []),
    "accelerate": (ACCELERATE, ["accelerate"]),
    "Lightning": (LIGHTNING, ["lightning"]),
    "Lightning by hand": (BY_HAND, ["lightning"]),
    "Fabric": (FABRIC, ["lightning"]),
    "workers, forked": (WORKERS.replace("CONTEXT", "fork"), []),
    "workers, spawned": (WORKERS.replace("CONTEXT", "spawn"), []),
    "torchrun": (TORCHRUN, []),
    "processes, spawned": (SPAWNED, []),
    "torch.compile": (COMPILED, ["torch._dynamo"]),
    "TorchScript": (SCRIPTED, []),
}
UNSEEN = FUSED
