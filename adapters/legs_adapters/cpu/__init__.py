"""Running an upstream training script without a GPU: devices redirected, CUDA modules replaced by stand-ins."""
