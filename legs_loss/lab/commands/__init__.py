"""Sub-commands of ``legs``, which finds them by their entry points: each as those in legs_loss/cli."""
