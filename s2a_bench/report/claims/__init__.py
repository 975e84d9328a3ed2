"""The paper's claims beside ours, one by one."""
