"""Other worlds: files other programs open, the DICOM network, OpenIGTLink. The method knows nothing of it."""
