"""How probable the data are with given effects, and the fit of several effects together."""
