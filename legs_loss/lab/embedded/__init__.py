"""The scene that the package makes itself, so that everything can be tried without a dataset."""

from legs_loss.lab.embedded.scene import write_embedded_scene as write_embedded_scene
