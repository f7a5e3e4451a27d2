"""The mobile side: read a camera, encode each frame, publish channel symbols."""
