"""Scalars that are traced, numbers of a model that vary, and how both become C++."""
