"""A small tree, its views, and nothing else: what demo, notebook and tests start from; made by scripts/make_data.py."""
