"""What both ends share: images, geometry, codecs, physical layer, messages, transport."""
