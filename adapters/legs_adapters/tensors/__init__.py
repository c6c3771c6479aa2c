"""The meaning of torch's operations: gradients, backward passes, optimiser steps. No splats."""
