"""Taking a billboard cloud to other programs as plain glTF or OBJ."""
