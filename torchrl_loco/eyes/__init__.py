"""What cameras of a model see, in all worlds at once: the rays, the shapes that they meet, and how these look."""
