"""Transport: the lines that devices hang on."""
