/* A third-party controller from fieldtwin's point of view: a plain Modbus TCP client with libmodbus.
 *
 *     loop FIELD_HOST FIELD_PORT OWN_PORT
 *
 * Every 200 ms it reads pressure (input registers 30001, 30002) and sampling period (holding register 40002) of unit 1, decides as
 * sampling.st does, and writes the period if the device has a different one. It serves its values and its output on OWN_PORT:
 * 30001, 30002 pressure; 40001 the period that it wants; 40002 is 1 while the sensor does not answer; 40003 counts its cycles.
 * Ends with SIGTERM. It does not use fieldtwin.
 */
#include <errno.h>
#include <modbus.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

enum { CYCLE_MS = 200, CLIENTS = 8, FAILURES = 3 };
enum { WANTED, ALARM, CYCLES, HOLDINGS };

static volatile sig_atomic_t ended;

static void end(int number) {
    (void)number;
    ended = 1;
}

static long now_ms(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * 1000L + t.tv_nsec / 1000000L;
}

/* One cycle. Returns 0, or -1 when the sensor did not answer. */
static int control(modbus_t *field, modbus_mapping_t *shown) {
    uint16_t pressure[2], period;
    if (modbus_read_input_registers(field, 0, 2, pressure) != 2 || modbus_read_registers(field, 1, 1, &period) != 1)
        return -1;
    float dbar = modbus_get_float_abcd(pressure);
    if (dbar > 50.0f)
        shown->tab_registers[WANTED] = 1;
    else if (dbar < 40.0f)
        shown->tab_registers[WANTED] = 5;
    memcpy(shown->tab_input_registers, pressure, sizeof pressure);
    if (period != shown->tab_registers[WANTED] && modbus_write_register(field, 1, shown->tab_registers[WANTED]) != 1)
        return -1;
    return 0;
}

int main(int argc, char **argv) {
    if (argc != 4) {
        fprintf(stderr, "usage: loop FIELD_HOST FIELD_PORT OWN_PORT\n");
        return 2;
    }
    struct sigaction action = {.sa_handler = end};
    sigaction(SIGTERM, &action, NULL);
    sigaction(SIGINT, &action, NULL);
    signal(SIGPIPE, SIG_IGN);

    modbus_t *field = modbus_new_tcp_pi(argv[1], argv[2]);
    modbus_t *own = modbus_new_tcp("0.0.0.0", atoi(argv[3]));
    modbus_mapping_t *shown = modbus_mapping_new(0, 0, HOLDINGS, 2);
    int listening = own ? modbus_tcp_listen(own, CLIENTS) : -1;
    if (!field || !shown || listening < 0) {
        fprintf(stderr, "loop: %s\n", modbus_strerror(errno));
        return 1;
    }
    modbus_set_slave(field, 1);
    modbus_set_response_timeout(field, 0, 300000);
    modbus_set_indication_timeout(own, 1, 0);
    shown->tab_registers[WANTED] = 5;

    struct pollfd fds[1 + CLIENTS] = {{.fd = listening, .events = POLLIN}};
    int clients = 0, connected = 0, failures = 0;
    long due = now_ms();
    while (!ended) {
        long wait = due - now_ms();
        if (wait <= 0) {
            if (!connected)
                connected = modbus_connect(field) == 0;
            if (connected && control(field, shown) == 0) {
                failures = 0;
            } else if (++failures >= FAILURES) { /* a reply may still arrive late on this connection, so open a new one */
                modbus_close(field);
                connected = 0;
            } else if (connected) {
                modbus_flush(field);
            }
            shown->tab_registers[ALARM] = failures >= FAILURES;
            shown->tab_registers[CYCLES]++;
            due = now_ms() + CYCLE_MS;
            continue;
        }
        if (poll(fds, 1 + clients, (int)wait) <= 0)
            continue;
        for (int i = clients; i >= 1; i--) {
            if (!fds[i].revents)
                continue;
            uint8_t query[MODBUS_TCP_MAX_ADU_LENGTH];
            modbus_set_socket(own, fds[i].fd);
            int length = modbus_receive(own, query);
            if (length > 0)
                modbus_reply(own, query, length, shown);
            if (length < 0) {
                close(fds[i].fd);
                fds[i] = fds[clients--];
            }
        }
        if (fds[0].revents && clients < CLIENTS) {
            int fd = modbus_tcp_accept(own, &listening);
            if (fd >= 0)
                fds[++clients] = (struct pollfd){.fd = fd, .events = POLLIN};
        }
    }
    return 0;
}
