"""What a person sees of a run: the scene and the viewers it is fed to."""
