"""The verbs for notebooks, scripts and commands, and the results that own what was found."""
