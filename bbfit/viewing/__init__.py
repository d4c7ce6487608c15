"""Looking at results in the browser: the original and the billboards side by side, levels of detail, and whole fields of them."""
