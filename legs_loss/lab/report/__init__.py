"""Pictures: contact sheets of weight maps and the curves, trainings side by side, a comparison as an HTML page."""
