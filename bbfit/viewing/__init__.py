"""The viewer: a web page that shows the original tree and its billboards side by side, levels of detail, and fields of trees."""
