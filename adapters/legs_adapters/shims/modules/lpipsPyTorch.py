"""lpipsPyTorch, which forks carry with them: as the package lpips."""

from legs_adapters.shims.modules.lpips import module

__all__ = ["module"]
