"""Export of billboard clouds to other programs as plain glTF or OBJ."""
