/* Many Modbus TCP clients in one thread: each reads 10 holding registers of unit 1, one request at a time, checked byte by byte.
 *
 *   modbus_clients HOST PORT SECONDS CLIENTS      prints requests per second, and the least and the most that one client got
 */
#include <arpa/inet.h>
#include <errno.h>
#include <netinet/tcp.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#define REPLY 29 /* MBAP 7, function 1, count 1, registers 20 */
#define MAX_CLIENTS 1000

typedef struct {
    int fd;
    uint16_t transaction;
    size_t have;
    uint8_t reply[REPLY];
    long done;
} client_t;

static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec + t.tv_nsec * 1e-9;
}

static void die(const char *what) {
    fprintf(stderr, "modbus_clients: %s: %s\n", what, strerror(errno));
    exit(1);
}

static void ask(client_t *c) {
    c->transaction++;
    uint8_t request[12] = {c->transaction >> 8, c->transaction & 255, 0, 0, 0, 6, 1, 3, 0, 0, 0, 10};
    c->have = 0;
    if (send(c->fd, request, sizeof request, 0) != sizeof request)
        die("send");
}

static void check(const client_t *c) {
    const uint8_t expected[9] = {c->transaction >> 8, c->transaction & 255, 0, 0, 0, 23, 1, 3, 20};
    if (memcmp(c->reply, expected, sizeof expected) != 0) {
        fprintf(stderr, "modbus_clients: a wrong reply\n");
        exit(1);
    }
}

int main(int argc, char **argv) {
    int clients = argc == 5 ? atoi(argv[4]) : 0;
    if (clients < 1 || clients > MAX_CLIENTS) {
        fprintf(stderr, "usage: modbus_clients HOST PORT SECONDS CLIENTS\n");
        return 2;
    }
    struct sockaddr_in server = {.sin_family = AF_INET, .sin_port = htons(atoi(argv[2]))};
    if (inet_pton(AF_INET, argv[1], &server.sin_addr) != 1)
        die(argv[1]);
    static client_t all[MAX_CLIENTS];
    int poll = epoll_create1(0), on = 1;
    for (int i = 0; i < clients; i++) {
        all[i].fd = socket(AF_INET, SOCK_STREAM, 0);
        if (connect(all[i].fd, (struct sockaddr *) &server, sizeof server) != 0)
            die("connect");
        setsockopt(all[i].fd, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
        struct epoll_event event = {.events = EPOLLIN, .data.ptr = &all[i]};
        epoll_ctl(poll, EPOLL_CTL_ADD, all[i].fd, &event);
    }
    double start = now(), end = start + atof(argv[3]), t = start;
    for (int i = 0; i < clients; i++)
        ask(&all[i]);
    long done = 0;
    while (t < end) {
        struct epoll_event events[64];
        int ready = epoll_wait(poll, events, 64, 1000);
        if (ready <= 0)
            die("no answer for a second");
        for (int i = 0; i < ready; i++) {
            client_t *c = events[i].data.ptr;
            ssize_t n = recv(c->fd, c->reply + c->have, REPLY - c->have, 0);
            if (n <= 0)
                die("the server closed");
            c->have += n;
            if (c->have < REPLY)
                continue;
            check(c);
            c->done++;
            done++;
            ask(c);
        }
        t = now();
    }
    long least = all[0].done, most = all[0].done;
    for (int i = 1; i < clients; i++) {
        least = all[i].done < least ? all[i].done : least;
        most = all[i].done > most ? all[i].done : most;
    }
    printf("%.1f %ld %ld\n", done / (t - start), least, most);
    return 0;
}
