"""Photographs to Gaussians: 3DGS's training on the CPU, what it is scored with, and several runs side by side."""

from legs_loss.lab.training.trainer import Progress, TrainConfig, train

__all__ = ["Progress", "TrainConfig", "train"]
