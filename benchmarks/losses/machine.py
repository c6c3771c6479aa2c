"""The machine that is measured: its processor or GPU, versions, threads."""

from __future__ import annotations

import os
import platform
from typing import Dict

import torch

__all__ = ["machine"]


def machine(device: torch.device) -> Dict[str, str]:
    """Return the processor and the versions that the numbers depend on."""
    name = platform.processor() or platform.machine()
    if os.path.exists("/proc/cpuinfo"):
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            name = next((line.split(":")[1].strip() for line in file if line.startswith("model name")), name)
    versions = {"python": platform.python_version(), "torch": torch.__version__}
    if device.type == "cuda":
        versions["gpu"], versions["cuda"] = torch.cuda.get_device_name(device), str(torch.version.cuda)
    for package in ("numba", "fused_ssim", "kornia", "pytorch_msssim", "torchmetrics"):
        try:
            versions[package] = str(getattr(__import__(package), "__version__", "installed"))
        except ImportError:
            versions[package] = "not installed"
    return {"processor": name, "cores": str(os.cpu_count()), **versions}
