"""Pictures: contact sheets of weight maps and the curves."""
