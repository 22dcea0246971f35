"""Tables, plots and a gallery of what was measured."""
