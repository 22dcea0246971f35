"""Tables, plots and a gallery of the measurements."""
