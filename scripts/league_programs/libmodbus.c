/* libmodbus in the league, as a client or a server: libmodbus client|server tcp|rtu [LINE]
 *
 * The client reads two registers 20 ms after the last answer, with a timeout of 150 ms, prints the first one, and connects again
 * after an error of the connection. The server behaves like the library's examples: it answers one client after the other, and
 * an invalid frame ends a TCP connection.
 */
#include <arpa/inet.h>
#include <errno.h>
#include <modbus.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

static int client(const char *wire)
{
    modbus_t *link = strcmp(wire, "tcp") == 0 ? modbus_new_tcp(getenv("FIELDTWIN_HOST"), atoi(getenv("FIELDTWIN_PORT")))
                                              : modbus_new_rtu(getenv("FIELDTWIN_TTY"), 19200, 'N', 8, 1);
    uint16_t values[2];
    modbus_set_slave(link, 1);
    modbus_set_response_timeout(link, 0, 150000);
    modbus_set_error_recovery(link, MODBUS_ERROR_RECOVERY_PROTOCOL);
    modbus_connect(link);
    for (;;) {
        if (modbus_read_registers(link, 0, 2, values) == 2) {
            printf("%u\n", values[0]);
        } else {
            int reason = errno;
            puts("error");
            if (reason == ECONNRESET || reason == EBADF || reason == EPIPE || reason == ENOTCONN || reason == EIO) {
                modbus_close(link);
                modbus_connect(link);
            }
        }
        fflush(stdout);
        usleep(20000);
    }
}

static int server(const char *wire, const char *line)
{
    modbus_mapping_t *map = modbus_mapping_new(48, 16, 200, 8);
    uint8_t query[MODBUS_TCP_MAX_ADU_LENGTH];
    int size;
    map->tab_registers[0] = 0xAA;
    map->tab_registers[1] = 0xBB;
    map->tab_registers[4] = 0x12;
    map->tab_input_registers[0] = 0x4120;
    if (strcmp(wire, "tcp") == 0) {
        modbus_t *link = modbus_new_tcp("127.0.0.1", 0);
        int listening = modbus_tcp_listen(link, 1);
        struct sockaddr_in address;
        socklen_t length = sizeof address;
        getsockname(listening, (struct sockaddr *)&address, &length);
        printf("0 %d\n", ntohs(address.sin_port));
        fflush(stdout);
        for (;;) {
            if (modbus_tcp_accept(link, &listening) < 0)
                return 1;
            while ((size = modbus_receive(link, query)) >= 0)
                if (size > 0)
                    modbus_reply(link, query, size, map);
            modbus_close(link);
        }
    }
    modbus_t *link = modbus_new_rtu(line, 115200, 'N', 8, 1);
    modbus_set_slave(link, 1);
    if (modbus_connect(link) != 0)
        return 1;
    puts("0 0");
    fflush(stdout);
    for (;;) {
        size = modbus_receive(link, query);
        if (size > 0)
            modbus_reply(link, query, size, map);
        else if (size < 0 && (errno == EIO || errno == EBADF))
            return 1;
    }
}

int main(int count, char **words)
{
    if (count < 3)
        return 2;
    return strcmp(words[1], "client") == 0 ? client(words[2]) : server(words[2], count > 3 ? words[3] : "");
}
