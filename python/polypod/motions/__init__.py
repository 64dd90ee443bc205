"""Reference motions of humanoids: files, drawings, retargeting, and the tasks that track them."""
