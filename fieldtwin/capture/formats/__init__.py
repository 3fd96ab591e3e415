"""Read and write the file formats of other programs: candump, pcap, CSV, CNV, modpoll."""
