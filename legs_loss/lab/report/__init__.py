"""Pictures: trainings side by side, a comparison as an HTML page, TensorBoard's log."""
