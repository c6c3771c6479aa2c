"""Photographs to Gaussians: 3DGS's training on the CPU, what it is scored with, and several runs side by side."""

from legs_loss.lab.training.trainer import Progress as Progress
from legs_loss.lab.training.trainer import TrainConfig as TrainConfig
from legs_loss.lab.training.trainer import train as train
