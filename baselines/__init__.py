"""The methods the paper compares with, one file each, with the same skeleton as hippo/hippo.py."""
