/* A bridge from Modbus TCP to RTU that does nothing but what every bridge has to do: the bound for benchmarks/bridge.py.
 *
 *     modbus_bridge PORT TTY SILENCE_US
 *
 * One client, one request at a time, no retries, no timeouts. After each reply it waits SILENCE_US (ppoll, timer slack of
 * 1 ns) before it sends the next request. The reply to function 03h is recognised by its byte count and its check sum.
 */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <err.h>
#include <fcntl.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/socket.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

static int64_t now_ns(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * 1000000000LL + t.tv_nsec;
}

static uint16_t crc16(const uint8_t *data, size_t size) {
    uint16_t crc = 0xFFFF;
    for (size_t i = 0; i < size; i++) {
        crc ^= data[i];
        for (int bit = 0; bit < 8; bit++)
            crc = crc & 1 ? (crc >> 1) ^ 0xA001 : crc >> 1;
    }
    return crc;
}

static int listen_at(int port) {
    int sock = socket(AF_INET, SOCK_STREAM, 0), one = 1;
    struct sockaddr_in where = {.sin_family = AF_INET, .sin_port = htons(port), .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
    setsockopt(sock, SOL_SOCKET, SO_REUSEADDR, &one, sizeof one);
    if (bind(sock, (struct sockaddr *)&where, sizeof where) || listen(sock, 8))
        err(1, "port %d", port);
    return sock;
}

static int open_tty(const char *path) {
    int tty = open(path, O_RDWR | O_NOCTTY | O_NONBLOCK);
    struct termios settings;
    if (tty < 0 || tcgetattr(tty, &settings))
        err(1, "%s", path);
    cfmakeraw(&settings);
    cfsetspeed(&settings, B115200);
    tcsetattr(tty, TCSANOW, &settings);
    tcflush(tty, TCIOFLUSH);
    return tty;
}

/* Serve one client until it goes. */
static void serve(int client, int tty, int64_t silence_ns, int64_t *heard_ns) {
    uint8_t request[260], frame[256], reply[260];
    size_t asked = 0, got = 0;
    int waiting = 0; /* for the reply of the unit */
    for (;;) {
        int whole = !waiting && asked >= 7 && asked >= 6u + (request[4] << 8 | request[5]);
        int64_t left_ns = whole ? *heard_ns + silence_ns - now_ns() : -1;
        if (whole && left_ns <= 0) {
            size_t size = (request[4] << 8 | request[5]);
            memcpy(frame, request + 6, size);
            uint16_t crc = crc16(frame, size);
            frame[size] = crc & 0xFF;
            frame[size + 1] = crc >> 8;
            if (write(tty, frame, size + 2) != (ssize_t)size + 2)
                err(1, "write");
            waiting = 1, got = 0;
            continue;
        }
        struct pollfd ends[2] = {{.fd = tty, .events = POLLIN}, {.fd = client, .events = whole || waiting ? 0 : POLLIN}};
        struct timespec left = {.tv_nsec = left_ns};
        if (ppoll(ends, 2, whole ? &left : NULL, NULL) < 0)
            err(1, "ppoll");
        if (ends[1].revents) {
            ssize_t size = read(client, request + asked, sizeof request - asked);
            if (size <= 0)
                return;
            asked += size;
        }
        if (ends[0].revents) {
            ssize_t size = read(tty, frame + got, sizeof frame - got);
            *heard_ns = now_ns();
            if (size <= 0)
                err(1, "the line");
            got += size;
            if (!waiting) { /* noise */
                got = 0;
                continue;
            }
            if (got >= 5 && got == 5u + frame[2] && crc16(frame, got) == 0) {
                size_t pdu = got - 2;
                memcpy(reply, request, 4);
                reply[4] = pdu >> 8, reply[5] = pdu & 0xFF;
                memcpy(reply + 6, frame, pdu);
                if (write(client, reply, 6 + pdu) < 0)
                    return;
                waiting = 0, asked = 0;
            }
        }
    }
}

int main(int argc, char **argv) {
    if (argc != 4)
        errx(2, "modbus_bridge PORT TTY SILENCE_US");
    prctl(PR_SET_TIMERSLACK, 1);
    int tty = open_tty(argv[2]), sock = listen_at(atoi(argv[1])), one = 1;
    int64_t heard_ns = 0;
    for (;;) {
        int client = accept(sock, NULL, NULL);
        if (client < 0)
            err(1, "accept");
        setsockopt(client, IPPROTO_TCP, TCP_NODELAY, &one, sizeof one);
        serve(client, tty, atoll(argv[3]) * 1000, &heard_ns);
        close(client);
    }
}
