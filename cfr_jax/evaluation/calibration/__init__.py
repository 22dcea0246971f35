"""What a confidence is fitted with and measured by: trials, the fit, reliability."""
